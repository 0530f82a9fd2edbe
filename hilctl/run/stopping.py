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
JOB_CONTROL: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name)
)
"""Signals by which a terminal suspends a process; a suspended supervisor would see no stop."""


def request_stop(run: RunFolder) -> bool:
    """Request a run to end by its safe ramp; return whether there was a process to take it.

    A guardian that still acts after the end of a run is ended at once.

    Raises:
        RunError: The kernel refuses.
    """
    try:
        process = os.pidfd_open(run.card.supervisor)
        try:
            # After the process was opened: while its lock is held the number can't be another's.
            if run.supervised:
                signal.pidfd_send_signal(process, STOP_SIGNAL)
                return True
        finally:
            os.close(process)
    except ProcessLookupError:
        pass
    except OSError as error:
        raise RunError(f"{run.card.name}: can't be stopped: {error.strerror}") from None
    return _end_guardian(run)


def _end_guardian(run: RunFolder) -> bool:
    if not run.alive:
        return False
    # Imported here: a stop must not wait for numpy.
    from hilctl.run.guardian_process import signal_guardian

    return signal_guardian(run, signal.SIGTERM)
