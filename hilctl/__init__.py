"""hilctl: a real-time hardware-in-the-loop compensator for smart-material actuators.

The packages, top to bottom; each imports those below it only:

cli          commands, messages and tables; the only package that prints
api          the same functions for a program of one's own
live         the live page of a run, and its server
studies      many runs of one experiment: campaigns, their figures and page, characterisation
comparison   models of the literature on the same loops
identify     parameters of models from measured data
analysis     figures, plots, pages, replay and export of a recording
ilc          iterative learning: corrections from run to run
run          the processes of a run: loop, supervisor, guardian; recording, requests, recovery
experiment   the file, what it refers to, and whether it may start; moves nothing
machine      what this computer can do
loop         everything that a tick executes
waveforms    reference samples from a few keys
recording    MCAP files: written, read, recovered
models       parameters, forward and inverse operators
signals      spectra, cycles and metrics of sampled signals
kernels      compiled arithmetic on plain arrays
base         arrays, errors, the device contract, samples, strict YAML

Devices are in ``hilctl_drivers``, which imports ``base`` and ``kernels`` only.
"""

import sys
import time

__version__ = "0.3.0"

# The matrices here are small: more BLAS threads make a fit many times slower on a busy machine, and
# the loop's process must not have any. It takes effect where numpy is not imported yet.
OWN_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment variables of hilctl's own processes, unless they are set."""

try:
    time.time()
except OverflowError:  # Python itself cannot import its logging then
    sys.stderr.write("hilctl: the clock must be before the year 2262: set this computer's clock\n")
    raise SystemExit(2) from None
