"""A request to stop: a signal of its own, which no other client and no full socket can keep out."""

import os
import signal

from hilctl.base.errors import RunError
from hilctl.run.run_folder import RunFolder

# Windows has neither, and no runs; recordings are read there with what runs are made of.
STOP_SIGNAL: signal.Signals = getattr(signal, "SIGUSR1", signal.SIGTERM)
"""What a supervisor takes for ``hilctl stop``."""
HANG_UP: signal.Signals = getattr(signal, "SIGHUP", signal.SIGTERM)
"""What a process gets when its terminal goes away."""


def request_stop(run: RunFolder) -> bool:
    """Request a run to end by its safe ramp; return whether there was a supervisor to take it.

    Raises:
        RunError: The kernel refuses.
    """
    try:
        process = os.pidfd_open(run.card.supervisor)
        try:
            # After the process was opened: while its lock is held the number can't be another's.
            if not run.supervised:
                return False
            signal.pidfd_send_signal(process, STOP_SIGNAL)
        finally:
            os.close(process)
    except ProcessLookupError:
        return False
    except OSError as error:
        raise RunError(f"{run.card.name}: can't be stopped: {error.strerror}") from None
    return True
