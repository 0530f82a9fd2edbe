"""Load, check and run an experiment."""

from collections.abc import Callable
from pathlib import Path

from hilctl.api.given import PathLike, Settings, path_or_none, texts_of
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.experiment.preflight import CheckedExperiment
from hilctl.run.result import Progress, RunResult
from hilctl.run.start import checked_experiment, output_of, start_run


def load(experiment: PathLike, settings: Settings = ()) -> "LoadedExperiment":
    """Read an experiment and what it refers to: its device, its model.

    Args:
        experiment: Experiment file (YAML).
        settings: Over it.

    Raises:
        InputError: It breaks rules; all of them are listed.
    """
    return load_experiment(Path(experiment), texts_of(settings))


def check(experiment: PathLike, settings: Settings = ()) -> "CheckedExperiment":
    """Hold an experiment against device, model and limits, as every run does; nothing moves.

    Args:
        experiment: Experiment file (YAML).
        settings: Over it.

    Raises:
        InputError: It can't be used; all problems are listed.
    """
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
    path, texts, chosen = Path(experiment), texts_of(settings), path_or_none(output)
    if not fast:
        return start_run(path, texts, chosen, overwrite, on_progress)
    from hilctl.run.unpaced import run_unpaced  # a supervisor does not need the loop

    checked = checked_experiment(path, texts)
    return run_unpaced(checked, output_of(checked, chosen), overwrite=overwrite)
