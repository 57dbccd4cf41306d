import os

# Tests run beside each other, one thread each: two spinning thread pools on two cores are slower than none
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch as th

th.set_num_threads(1)
