"""The loop's own process: what it is before it has a job.

Started by the supervisor in :mod:`hilctl.run.waiting_loop`, before that has its experiment; the job
comes over the socket that is its standard input, and the locks with it. Until then it imports only
what every run needs: whether it is to check anything is known with the job.
"""

import signal
import sys

from hilctl.kernels import atomics
from hilctl.kernels.interlock import interlock_block
from hilctl.kernels.jit import ensure_compiled
from hilctl.kernels.limit import limit_block
from hilctl.machine.realtime import be_ordinary
from hilctl.run.waiting_loop import PLAIN, received_job

_EVERY_RUN = (atomics.publish, atomics.observe, limit_block, interlock_block)


def main() -> int:
    """Run one job; the exit code is 0 where the loop ended by its safe ramp."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor decides, and the loop ramps down
    be_ordinary()  # as its maker is by the time that it has a job
    ensure_compiled(*_EVERY_RUN)  # while the supervisor checks
    job = received_job(sys.stdin.fileno())
    if not job:
        return 0  # there is no run for this one
    if job.startswith(PLAIN):
        import hilctl.base.plain  # noqa: F401  before what would import pydantic
    from hilctl.run.carried_out import carry_out

    return carry_out(job)
