import os

# Tests run in parallel processes with one thread each, because competing thread pools slow each other down
os.environ.setdefault("OMP_NUM_THREADS", "1")
# They compare bit by bit, and a GPU is not bit-exact. With CUDA_VISIBLE_DEVICES=0 they use it, and those fail that give a
# model tensors of the CPU, or expect that there is no GPU
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

import torch as th

th.set_num_threads(1)
