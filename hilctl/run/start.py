"""From an experiment file to a finished run, in real time or not; identity of a run."""

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

from hilctl.base.errors import DataError, RunError
from hilctl.base.files import check_no_input, make_folder
from hilctl.experiment.correction import dump_correction
from hilctl.experiment.load import LoadedExperiment, input_files, load_experiment
from hilctl.experiment.preflight import CheckedExperiment, check
from hilctl.models.model_file import dump_model
from hilctl.recording.run_summary import read_ends
from hilctl.run.metadata import experiment_sha256, sha256_of
from hilctl.run.own_process import has_threads, run_in_own_process
from hilctl.run.result import Progress, RunResult
from hilctl.run.run_folder import require_linux
from hilctl.run.unpaced import run_unpaced

_log = logging.getLogger(__name__)

OnPart: TypeAlias = Callable[[float], None]  # called with the completed part of a run, 0 to 1


def checked_experiment(
    path: Path, settings: Sequence[str], heat_a2: float = 0.0
) -> CheckedExperiment:
    """Load an experiment and check it against device, model and limits.

    ``settings`` are ``key=value`` texts that override the file; ``heat_a2`` is the minimum heat of
    the coil, in A^2.

    Raises:
        InputError: The experiment is not valid; all problems are listed.
    """
    return check(load_experiment(path, settings), heat_a2)


def output_of(checked: CheckedExperiment, output: Path | None) -> Path:
    """Return the recording to write: ``output``, or a new name in the folder of recordings.

    Raises:
        InputError: The folder cannot be created, or ``output`` is an input of the run.
    """
    if output is not None:
        loaded = checked.loaded
        # A recording may be an input: of a waveform, or of the initial state.
        check_no_input(output, input_files(loaded.document, loaded.folder / "experiment"))
        return output
    folder = Path(checked.loaded.config.recording.folder)
    make_folder(folder)
    return default_output(checked.loaded.config.name, folder, time.localtime())


def start_run(
    path: Path,
    settings: Sequence[str],
    output: Path | None,
    overwrite: bool,
    on_progress: Callable[[Progress], None],
    heat_a2: float = 0.0,
) -> RunResult:
    """Run an experiment file to its end.

    In a program with threads, such as a notebook, it runs in a separate process.

    Raises:
        InputError: Nothing has moved, and no file is left.
        RunError: The run failed to start; nothing has moved, and no file is left.
    """
    require_linux()
    if has_threads():
        return run_in_own_process((path, settings, output, overwrite, heat_a2), on_progress)
    from hilctl.run.supervisor import Supervisor  # Linux only

    checked = checked_experiment(path, settings, heat_a2)
    # A real device has hysteresis memory: log the assumed initial state.
    if checked.begun.begins and checked.loaded.device.info.holds:
        _log.warning("the compensator begins %s", checked.begun.begins)
    output = output_of(checked, output)
    return Supervisor(checked, output, overwrite=overwrite, on_progress=on_progress).run()


def default_output(name: str, folder: Path, now: time.struct_time) -> Path:
    """Return the default file name of a recording: ``folder/name-date-time.mcap``."""
    stamp = time.strftime("%Y%m%d-%H%M%S", now)
    candidate = folder / f"{name}-{stamp}.mcap"
    number = 2
    while os.path.lexists(candidate):
        candidate = folder / f"{name}-{stamp}-{number}.mcap"
        number += 1
    return candidate


def paced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = lambda _: None,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run in real time into a file; see :func:`start_run`."""

    def show(progress: Progress) -> None:
        on_part(progress.samples / max(progress.total, 1))

    return start_run(path, settings, output, overwrite, show, heat_a2)


def unpaced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = lambda _: None,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run a simulated device without real time into a file."""
    del on_part
    checked = checked_experiment(path, settings, heat_a2=heat_a2)
    return run_unpaced(checked, output, overwrite=overwrite)


class StepStoppedError(RunError):
    """A run of a study was stopped by a signal; earlier recordings are kept."""

    def __init__(self, text: str, number: int) -> None:
        super().__init__(text)
        self.signal = number


@dataclass(frozen=True, slots=True)
class RunKey:
    """SHA-256 of a run's experiment, model and correction; the latter are empty without one."""

    experiment: str
    model: str = ""
    correction: str = ""

    @classmethod
    def of(cls, loaded: LoadedExperiment) -> Self:
        """Return the key of an experiment."""
        model = dump_model(loaded.model) if loaded.model else ""
        correction = dump_correction(loaded.correction) if loaded.correction else ""
        return cls(experiment_sha256(loaded), sha256_of(model), sha256_of(correction))

    @classmethod
    def of_facts(cls, run: Mapping[str, str]) -> Self:
        """Return the key of a recorded run from its metadata."""
        names = ("experiment_sha256", "model_sha256", "correction_sha256")
        return cls(*(run.get(name, "") for name in names))


def completed_key(path: Path) -> RunKey | None:
    """Return the key of a recording; None unless its run was completed."""
    try:
        ends = read_ends(path)
    except DataError:
        return None
    return RunKey.of_facts(ends.run) if ends.end.get("code") == "completed" else None
