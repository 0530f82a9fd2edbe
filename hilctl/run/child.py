"""The supervisor's hold on the loop's process: start it, wait for it, learn how it ended."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from hilctl.base.errors import InputError, RunError
from hilctl.experiment.check import Checked
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, PageText, Phase
from hilctl.run.waiting_loop import taken

_READY_TIMEOUT_S = 120.0
_DEATH_S = 0.1


class LoopChild:
    """The loop process of one run.

    Args:
        checked: The experiment.
        folder: The run's folder, with its ring.
        ring: That ring.
        inherits: Descriptors of locks that it is to hold.
        silence_s: Longest that the supervisor may be silent.
    """

    def __init__(
        self,
        checked: Checked,
        folder: RunFolder,
        ring: SampleRing,
        inherits: Sequence[int],
        silence_s: float,
    ) -> None:
        self._page = ring.page
        job = Job.of(checked, folder, supervisor=os.getpid(), silence_s=silence_s)
        # One that died at once is reported by await_ready.
        self._process = taken().give(job.to_bytes(), inherits)

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
        while page.observe(Field.PHASE) == Phase.STARTING and not self.ended:
            if stopped():
                raise RunError("stopped before the start; nothing has moved")
            if time.monotonic() > deadline:
                raise RunError(f"the loop was not ready within {_READY_TIMEOUT_S:g} s")
            time.sleep(0.005)
        if page.observe(Field.PHASE) == Phase.REFUSED:
            raise InputError(page.read_text(PageText.ERROR))
        if page.observe(Field.PHASE) == Phase.FAILED:
            raise RunError(page.read_text(PageText.ERROR))
        if page.observe(Field.PHASE) != Phase.READY:
            raise RunError(f"the loop process died before the start: {self._death()}")

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def kill(self, wait_s: float = _DEATH_S) -> None:
        """End it at once; one that the kernel keeps from dying is not waited for.

        Args:
            wait_s: Longest wait until it is gone.
        """
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)

    def death(self) -> str:
        """Return why it could not say how it ended."""
        if self._page.observe(Field.PHASE) == Phase.FAILED:
            return self._page.read_text(PageText.ERROR)
        return f"the loop process died: {self._death()}"

    def _death(self) -> str:
        code = self._process.poll()
        if code is None:
            return "it can't be ended: the kernel keeps it"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
