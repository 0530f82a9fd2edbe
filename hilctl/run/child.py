"""The processes that the supervisor starts: their end, and the loop process as one of them."""

import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from hilctl.base.errors import InputError, RunError
from hilctl.run.job import start_process
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import PageField, PageSlot, Phase, SharedPage

_READY_TIMEOUT_S = 120.0
_DEATH_S = 0.1


class ChildProcess:
    """A process of a run.

    Args:
        process: The process, started.
    """

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self._process = process

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def kill(self, wait_s: float = _DEATH_S) -> None:
        """Kill it; do not wait longer for a process that is blocked in the kernel.

        Args:
            wait_s: Longest wait until it is gone.
        """
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)


class LoopProcess(ChildProcess):
    """The loop process of one run; see :mod:`hilctl.run.loop_process`.

    Args:
        folder: The run's folder, with its job.
        page: Shared with it.
        inherits: Descriptors of locks that it is to hold.

    Raises:
        RunError: It cannot be started.
    """

    def __init__(self, folder: RunFolder, page: SharedPage, inherits: Sequence[int]) -> None:
        self._page = page
        try:
            process = start_process("hilctl.run.loop_process", str(folder.job), inherits=inherits)
        except OSError as error:
            raise RunError(f"cannot start the loop process: {error.strerror}") from None
        super().__init__(process)

    def await_ready(self, stopped: Callable[[], bool]) -> None:
        """Wait until it needs only the start signal.

        Args:
            stopped: Whether a stop has been requested.

        Raises:
            InputError: It refuses what it is asked for; nothing has moved.
            RunError: It could not be started; nothing has moved.
        """
        page = self._page
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while page.observe(PageField.PHASE) == Phase.STARTING and not self.ended:
            if stopped():
                raise RunError("stopped before the start; nothing has moved")
            if time.monotonic() > deadline:
                raise RunError(f"the loop was not ready within {_READY_TIMEOUT_S:g} s")
            time.sleep(0.005)
        if page.observe(PageField.PHASE) == Phase.REFUSED:
            raise InputError(page.read_text(PageSlot.ERROR))
        if page.observe(PageField.PHASE) == Phase.FAILED:
            raise RunError(page.read_text(PageSlot.ERROR))
        if page.observe(PageField.PHASE) != Phase.READY:
            raise RunError(f"the loop process died before the start: {self._death()}")

    def death(self) -> str:
        """Return why it could not say how it ended."""
        if self._page.observe(PageField.PHASE) == Phase.FAILED:
            return self._page.read_text(PageSlot.ERROR)
        return f"the loop process died: {self._death()}"

    def _death(self) -> str:
        code = self._process.poll()
        if code is None:
            return "it can't be ended: the kernel keeps it"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
