"""hilctl: a real-time hardware-in-the-loop compensator for smart-material actuators."""

import os

__version__ = "0.1.0"

# The matrices here are small: more BLAS threads make a fit many times slower on a busy machine, and
# the loop's process must not have any. It takes effect where numpy is not imported yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
