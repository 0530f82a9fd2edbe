"""From an experiment file to a finished run: load, check, run."""

import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from hilctl.base.errors import InputError
from hilctl.base.files import check_no_input
from hilctl.base.remedy import reason
from hilctl.experiment.check import Checked, check
from hilctl.experiment.load import input_files, load_experiment
from hilctl.run.architecture import require_linux
from hilctl.run.own_process import has_threads, run_in_own_process
from hilctl.run.result import Progress, RunResult

_log = logging.getLogger(__name__)


def checked_experiment(path: Path, settings: Sequence[str], heat_a2: float = 0.0) -> Checked:
    """Load an experiment and hold it against device, model and limits.

    Args:
        path: Experiment file.
        settings: ``key=value`` texts over it.
        heat_a2: Heat that its coil has at least, in A^2.

    Raises:
        InputError: It can't be used, all problems are listed.
    """
    return check(load_experiment(path, settings), heat_a2)


def output_of(checked: Checked, output: Path | None) -> Path:
    """Return the recording to write: the one given, or a new name in the experiment's folder.

    Raises:
        InputError: The folder can't be made, or the run reads that file.
    """
    if output is not None:
        loaded = checked.loaded
        # A recording may be one of them: of a waveform, or of where the actuator stands.
        check_no_input(output, input_files(loaded.document, loaded.folder / "experiment"))
        return output
    folder = Path(checked.loaded.config.recording.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made: {reason(error)}") from None
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

    A program with threads, such as a notebook or a window, runs it in a process of its own.

    Args:
        path: Experiment file.
        settings: ``key=value`` texts over it.
        output: Recording to write; a name in the experiment's folder where None.
        overwrite: Whether an existing recording may be replaced.
        on_progress: Called with each batch of samples.
        heat_a2: Heat that the coil has at least, in A^2, whatever the last run of it says.

    Raises:
        InputError: Nothing has moved, and no file is left.
        RunError: The device could not be opened; nothing has moved, and no file is left.
    """
    require_linux()
    if has_threads():
        given = (path, settings, output, overwrite, heat_a2)
        return run_in_own_process(given, on_progress)
    return _run(path, settings, output, overwrite, on_progress, heat_a2)


def _run(
    path: Path,
    settings: Sequence[str],
    output: Path | None,
    overwrite: bool,
    on_progress: Callable[[Progress], None],
    heat_a2: float,
) -> RunResult:
    # Not before: what only checks or computes works where a supervisor can't be imported.
    from hilctl.run.supervisor import Supervisor

    checked = checked_experiment(path, settings, heat_a2)
    # Of a device with a past: nobody should have to look into the recording for what was taken.
    if checked.begun.begins and checked.loaded.device.info.holds:
        _log.warning("the compensator begins %s", checked.begun.begins)
    output = output_of(checked, output)
    return Supervisor(checked, output, overwrite=overwrite, on_progress=on_progress).run()


def default_output(name: str, folder: Path, now: time.struct_time) -> Path:
    """Return the file for a run that was given none: ``folder/name-date-time.mcap``."""
    stamp = time.strftime("%Y%m%d-%H%M%S", now)
    candidate = folder / f"{name}-{stamp}.mcap"
    number = 2
    while os.path.lexists(candidate):
        candidate = folder / f"{name}-{stamp}-{number}.mcap"
        number += 1
    return candidate
