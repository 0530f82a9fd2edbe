"""The supervisor's hold on the loop process: start it, wait for it, hear how it ended."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from hilctl.base.errors import InputError, RunError
from hilctl.experiment.check import Checked
from hilctl.loop.plan import Outcome
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, Phase

_READY_TIMEOUT_S = 120.0


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
        self._ring = ring
        np.save(folder.reference, checked.reference.values)
        job: dict[str, Any] = {
            "experiment": checked.loaded.yaml_text,
            "folder": str(checked.loaded.folder.resolve()),
            "files": checked.loaded.files.texts,
            "ring": str(folder.ring),
            "reference": str(folder.reference),
            "supervisor": os.getpid(),
            "silence_s": silence_s,
        }
        if checked.ahead is not None:
            np.save(folder.ahead, checked.ahead)
            job["ahead"] = str(folder.ahead)
        if checked.state is not None:
            job["state"] = checked.state.tolist()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hilctl.run.loop_process"],
            stdin=subprocess.PIPE,
            start_new_session=True,  # a Ctrl-C in the terminal is the supervisor's to handle
            pass_fds=inherits,
        )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it died at once, which is told where it is waited for
            self._process.stdin.write(json.dumps(job).encode())
            self._process.stdin.close()

    def await_ready(self, stopped: Callable[[], bool]) -> None:
        """Wait until it only needs the word to start.

        Args:
            stopped: Whether somebody has asked for a stop.

        Raises:
            InputError: It refuses what it is asked for; nothing has moved.
            RunError: It could not be started; nothing has moved.
        """
        ring = self._ring
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while ring.get(Field.PHASE) == Phase.STARTING and not self.ended:
            if stopped():
                raise RunError("stopped before the start; nothing has moved")
            if time.monotonic() > deadline:
                raise RunError(f"the loop was not ready within {_READY_TIMEOUT_S:g} s")
            time.sleep(0.005)
        if ring.get(Field.PHASE) == Phase.REFUSED:
            raise InputError(ring.read_text())
        if ring.get(Field.PHASE) == Phase.FAILED:
            raise RunError(ring.read_text())
        if ring.get(Field.PHASE) != Phase.READY:
            raise RunError(f"the loop process died before the start: {self._death()}")

    @property
    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()

    def outcome(self) -> Outcome | str:
        """Return how it ended, or why it could not say so."""
        if self._ring.get(Field.PHASE) == Phase.ENDED:
            try:
                return Outcome(**json.loads(self._ring.read_text()))
            except (ValueError, TypeError):
                return "the loop process left no account of its end"
        if self._ring.get(Field.PHASE) == Phase.FAILED:
            return self._ring.read_text()
        return f"the loop process died: {self._death()}"

    def _death(self) -> str:
        code = self._process.wait()
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
