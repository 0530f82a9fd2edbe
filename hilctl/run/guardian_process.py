"""The guardian as a child process: start it, read its phase and heartbeat, end it.

What it does is in :mod:`hilctl.run.guardian`, which imports as little as possible.
"""

import logging
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress

from hilctl.run.child import ChildProcess
from hilctl.run.job import start_process
from hilctl.run.ring import SampleRing, safe_result_of
from hilctl.run.run_folder import RunFolder, locked_run, runs
from hilctl.run.shared_page import GuardianPhase, PageField, PageSlot, SharedPage

_log = logging.getLogger(__name__)

_END_S = 1.0
_POLL_S = 0.01
START_S = 10.0
"""Longest wait for a new guardian to drive the device."""


class GuardianProcess(ChildProcess):
    """The guardian of one run; see :mod:`hilctl.run.guardian`.

    Args:
        folder: The run's folder, with its job and ring.
        page: Shared with it.
        inherits: Descriptors of locks that it is to hold.
        loop: Process number of the loop to watch; None to act at once.

    Raises:
        OSError: It cannot be started.
    """

    def __init__(
        self, folder: RunFolder, page: SharedPage, inherits: Sequence[int], loop: int | None
    ) -> None:
        self._page = page
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.STARTING)
        page.put(PageField.GUARDIAN_HEARTBEAT_NS, 0)
        self._log = folder.guardian_log
        with ExitStack() as stack:
            watched = []
            if loop is not None:
                watched.append(os.pidfd_open(loop))
                stack.callback(os.close, watched[0])
            process = start_process(
                "hilctl.run.guardian",
                str(folder.job),
                *(["act"] if loop is None else [str(watched[0]), str(loop)]),
                inherits=(*inherits, *watched),
                stderr=stack.enter_context(self._log.open("wb")),
            )
        super().__init__(process)

    @property
    def phase(self) -> GuardianPhase:
        """How far it has come."""
        return GuardianPhase(self._page.get(PageField.GUARDIAN_PHASE))

    @property
    def heartbeat_ns(self) -> int:
        """Time of its last heartbeat, monotonic; 0 before the first."""
        return self._page.get(PageField.GUARDIAN_HEARTBEAT_NS)

    @property
    def error(self) -> str:
        """Why it does not act."""
        if not self.ended and self.phase != GuardianPhase.FAILED:
            return "it does not start"
        if self.phase == GuardianPhase.FAILED:
            return self._page.read_text(PageSlot.GUARDIAN)
        with suppress(OSError):
            *_, last = self._log.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
            return f"it died: {last}" if last else "it died"
        return "it died"

    def await_acting(self, stopped: Callable[[], bool] = lambda: False) -> bool:
        """Wait until it drives the device; return False if it does not within 10 s.

        Args:
            stopped: Whether the user ends the wait.
        """
        deadline_s = time.monotonic() + START_S
        while not self.ended and time.monotonic() < deadline_s and not stopped():
            if self.phase in {GuardianPhase.ACTING, GuardianPhase.DONE}:
                return True
            time.sleep(_POLL_S)
        return False

    def end(self) -> None:
        """Let it end by itself, as it does when the loop has; not for long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
            return
        self.kill()


class GuardianRelief:
    """Takes devices over from the guardians that still drive them, after the end of their runs.

    Args:
        holds: What the devices hold alone, as :attr:`hilctl.base.device.DeviceInfo.holds`.

    Attributes:
        runs: The runs whose guardians were stopped.
    """

    def __init__(self, holds: Sequence[str]) -> None:
        self.runs = [
            run
            for run in (runs() if holds else [])
            if set(holds) & set(run.card.holds) and safe_result_of(run)
        ]
        for run in self.runs:
            signal_guardian(run, signal.SIGKILL, _END_S)

    def resume(self, inherits: Sequence[int]) -> None:
        """Start them again and wait until they act: the outputs are not at their safe values.

        A command that follows finds them in that state, and can stop or relieve them.

        Args:
            inherits: Descriptors of the devices' locks.
        """
        for run in self.runs:
            try:
                with locked_run(run) as lock:
                    page = SampleRing(run.ring).page
                    guardian = GuardianProcess(run, page, [*inherits, lock], None)
                error = "" if guardian.await_acting() else guardian.error
            except (OSError, ValueError) as failure:
                error = str(failure)
            if error:
                _log.error("the guardian of %s cannot be started again: %s", run.card.name, error)

    def discard(self) -> None:
        """Remove their folders: another process drives the devices."""
        for run in self.runs:
            with suppress(OSError, ValueError):
                if SampleRing(run.ring, look_only=True).page.get(PageField.RECORDED):
                    run.remove()


def signal_guardian(run: RunFolder, number: int, wait_s: float = 0.0) -> bool:
    """Send a signal to the guardian of a run; return whether there was one.

    Args:
        run: The run.
        number: The signal.
        wait_s: Longest wait for its end.
    """
    try:
        guardian = os.pidfd_open(
            SampleRing(run.ring, look_only=True).page.get(PageField.GUARDIAN_PID)
        )
    except (OSError, ValueError):
        return False  # it has just ended
    try:
        # After the process was opened: while it holds the lock, the number is no other's.
        if not run.alive:
            return False
        signal.pidfd_send_signal(guardian, number)
        select.select([guardian], [], [], wait_s)
    except ProcessLookupError:
        return False
    finally:
        os.close(guardian)
    return True
