import os

# Tests run beside each other, one thread each: two spinning thread pools on two cores are slower than none
os.environ.setdefault("OMP_NUM_THREADS", "1")
# They compare bit by bit, which a GPU does not promise; CUDA_VISIBLE_DEVICES=0 shows it to them
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

import torch as th

th.set_num_threads(1)
