"""Step runner of campaigns and characterisations: host, disk space, cooling and progress.

The recordings are the checkpoint: a step is done if a completed recording of its experiment exists.
A killed study loses one run and resumes with the same command.
"""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.files import exists
from hilctl.experiment.state_files import MachineTime
from hilctl.run.result import RunResult
from hilctl.run.start import StepStoppedError, paced

_SPARE = 1.2
_WAIT_SHOWN_S = 1.0


@dataclass(frozen=True, slots=True)
class StudyHost:
    """Runs, time and observers of a study."""

    run: Callable[..., RunResult] = paced
    now: Callable[[], MachineTime] = MachineTime.now
    sleep_s: Callable[[float], None] = time.sleep
    # With the part that is done, 0 to 1, and a description.
    on_progress: Callable[[float, str], None] = field(default=lambda done, text: None)
    on_step: Callable[..., None] = field(default=lambda *result: None)  # with each step's result
    # With a note on each repaired recording.
    on_note: Callable[[str], None] = field(default=lambda text: None)


class StepRunner:
    """Run steps, wait for the coil to cool, and report progress from the planned times."""

    def __init__(self, host: StudyHost, total_s: float) -> None:
        self._host, self._total_s = host, max(total_s, 1e-9)
        self.done_s = 0.0

    def run(
        self,
        path: Path,
        settings: list[str],
        output: Path,
        text: str,
        seconds: float,
        *,
        overwrite: bool,
        heat_a2: float = 0.0,
    ) -> RunResult:
        """Run one step, which takes ``seconds``, with at least the heat ``heat_a2`` in its coil."""

        def on_part(part: float) -> None:
            self.show(text, part * seconds)

        on_part(0.0)
        return self._host.run(path, settings, output, on_part, overwrite=overwrite, heat_a2=heat_a2)

    def cool(self, name: str, pause_s: float) -> None:
        """Wait for the coil to cool."""
        while pause_s > 0.0:
            self.show(f"{name}: the coil cools for {pause_s:.0f} s")
            self._host.sleep_s(min(pause_s, _WAIT_SHOWN_S))
            pause_s -= _WAIT_SHOWN_S

    def show(self, text: str, seconds: float = 0.0) -> None:
        """Report progress: a description and the time left."""
        done_s = self.done_s + seconds
        left = timedelta(seconds=max(0, round(self._total_s - done_s)))
        self._host.on_progress(done_s / self._total_s, f"{text}; {left} left")


def setting(key: str, value: Any) -> str:
    """Return the ``key=value`` text that sets a key to a plain value."""
    return f"{key}={json.dumps(value, ensure_ascii=False)}"


def raise_if_stopped(name: str, result: RunResult) -> None:
    """Raise StepStoppedError if the user stopped a step."""
    if result.stop_signal:
        raise StepStoppedError(f"{name}: {result.reason}", result.stop_signal)


def free_mb(folder: Path) -> float:
    """Return the free disk space for a folder that may not exist yet, in MB."""
    around = next(path for path in (folder, *folder.absolute().parents) if exists(path))
    return shutil.disk_usage(around).free / 1e6


def require_room(folder: Path, needed_mb: float, available_mb: float) -> None:
    """Raise InputError if the disk has no room for the recordings of a study."""
    if available_mb < _SPARE * needed_mb:
        sizes = f"{needed_mb:.0f} MB needed, {available_mb:.0f} MB free"
        raise InputError(f"{folder}: no room for the recordings: {sizes}")
