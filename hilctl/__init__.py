"""hilctl: a real-time hardware-in-the-loop compensator for smart-material actuators.

The rooms, top to bottom; each sees those below it:

cli          commands, messages and tables; the only room that prints
api          all of it from a program of one's own; what is kept
desk         who looks on: the live page of a run, and its server
campaign     many runs of one experiment, kept and resumed
series       many runs side by side: what varied, figures and page of all of them
characterise from a wired device to its model: a campaign of runs
learning     corrections from run to run
comparison   models of the literature on the same loops
identify     measured data in, model parameters out
analysis     figures, plots, pages, replay and export of a recording
run          three processes round one loop: recording, requests, recovery
experiment   the file, what it refers to, and whether it may start; moves nothing
machine      what this computer can do
loop         everything that a tick executes
waveforms    reference samples from a few keys
recording    MCAP in, out, recovered
models       parameters, forward and inverse operators
kernels      compiled arithmetic on plain arrays
base         what all share: arrays, errors, the device contract, samples, strict YAML

Devices stand in ``hilctl_drivers``, which sees ``base`` and ``kernels`` only.
"""

import os

__version__ = "0.2.0"

# The matrices here are small: more BLAS threads make a fit many times slower on a busy machine, and
# the loop's process must not have any. It takes effect where numpy is not imported yet.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
