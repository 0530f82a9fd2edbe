"""What moves an actuator, and what is held against it before."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hilctl.api.given import PathLike, Settings, path_or_none, texts_of
from hilctl.base.errors import InputError

if TYPE_CHECKING:
    from hilctl.experiment.check import Checked
    from hilctl.experiment.load import LoadedExperiment
    from hilctl.learning.results import Learned, Row
    from hilctl.run.result import Progress, RunResult


def load(experiment: PathLike, settings: Settings = ()) -> "LoadedExperiment":
    """Read an experiment and what it refers to: its device, its model.

    Args:
        experiment: Experiment file (YAML).
        settings: Over it.

    Raises:
        InputError: It breaks rules; all of them are listed.
    """
    from hilctl.experiment.load import load_experiment

    return load_experiment(Path(experiment), texts_of(settings))


def check(experiment: PathLike, settings: Settings = ()) -> "Checked":
    """Hold an experiment against device, model and limits, as every run does; nothing moves.

    Args:
        experiment: Experiment file (YAML).
        settings: Over it.

    Raises:
        InputError: It can't be used; all problems are listed.
    """
    from hilctl.run.start import checked_experiment

    return checked_experiment(Path(experiment), texts_of(settings))


def run(
    experiment: PathLike,
    output: PathLike | None = None,
    *,
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    on_progress: "Callable[[Progress], None]" = lambda progress: None,
) -> "RunResult":
    """Run an experiment and record it. SIGINT and SIGTERM end it by its safe ramp.

    It may be called in any thread: beside other threads the run has a process of its own, and
    signals are passed on to it where the caller is the main thread. A connection stops it from any.

    Args:
        experiment: Experiment file (YAML).
        output: Recording to write; a new name in the experiment's folder where None.
        settings: Over the experiment.
        fast: Do not wait for real time: simulated devices only, any computer.
        overwrite: Whether a recording of that name may be replaced.
        on_progress: Called with each batch of samples of a run that keeps real time.

    Returns:
        How it ended; ``path`` is the recording. A fault is a result, not an error.

    Raises:
        InputError: Nothing has moved, and no file is left.
        RunError: The device could not be opened; nothing has moved, and no file is left.
    """
    from hilctl.run.start import checked_experiment, output_of, start_run

    path, texts, chosen = Path(experiment), texts_of(settings), path_or_none(output)
    if not fast:
        return start_run(path, texts, chosen, overwrite, on_progress)
    # Not before: a supervisor has no use for a loop of its own.
    from hilctl.run.unpaced import run_unpaced

    checked = checked_experiment(path, texts)
    return run_unpaced(checked, output_of(checked, chosen), overwrite=overwrite)


def learn(
    experiment: PathLike,
    output: PathLike,
    *,
    cycles: int = 20,
    folder: PathLike | None = None,
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    on_rows: "Callable[[Sequence[Row]], None]" = lambda rows: None,
) -> "Learned":
    """Learn a correction for a reference that repeats: run, correct, and run again.

    Args:
        experiment: Experiment file (YAML).
        output: Correction file to write.
        cycles: Most runs after the first.
        folder: Where each run is kept; ``OUTPUT-runs`` where None.
        settings: Over the experiment.
        fast: Do not wait for real time; simulated devices only.
        overwrite: Whether files of these names may be replaced.
        on_rows: Called with the figures of each run.

    Raises:
        InputError: Something can't be used or written; nothing has moved.
    """
    from hilctl.base.files import check_no_input, check_writable
    from hilctl.experiment.correction import write_correction
    from hilctl.experiment.load import inputs_of
    from hilctl.learning.session import Session
    from hilctl.run.start import paced, unpaced

    file, chosen = Path(output), runs_folder(output, folder)
    inputs = inputs_of(Path(experiment), texts_of(settings))
    check_writable(file, overwrite=overwrite, inputs=inputs)
    for path in chosen.glob("run-*.*"):
        check_no_input(path, inputs)
    if not overwrite and any(chosen.glob("run-*.mcap")):
        raise InputError(f"{chosen}: holds runs already: give another --folder, or --overwrite")
    session = Session(Path(experiment), texts_of(settings), chosen, unpaced if fast else paced)
    learned = session.learn(cycles, on_rows)
    write_correction(file, learned.correction, overwrite=overwrite)
    return learned


def runs_folder(output: PathLike, folder: PathLike | None = None) -> Path:
    """Return where the runs that lead to a file are kept."""
    file = Path(output)
    return path_or_none(folder) or file.with_name(f"{file.stem}-runs")
