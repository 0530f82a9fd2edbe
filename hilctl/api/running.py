"""What moves an actuator, and what is held against it before."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hilctl.api.given import PathLike, Settings, path_or_none, texts_of
from hilctl.base.errors import InputError

if TYPE_CHECKING:
    from hilctl.campaign.session import SeriesResult
    from hilctl.characterise.results import Characterisation
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

    checked = checked_experiment(path, texts, chosen)
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
    from hilctl.base.files import check_writable
    from hilctl.experiment.correction import write_correction
    from hilctl.learning.session import Session
    from hilctl.run.step import paced, unpaced

    file, chosen = Path(output), runs_folder(output, folder)
    check_writable(file, overwrite=overwrite)
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


def characterise(
    experiment: PathLike,
    output: PathLike,
    *,
    folder: PathLike | None = None,
    settings: Settings = (),
    highest_hz: float | None = None,
    fast: bool = False,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> "Characterisation":
    """Find a model of a wired actuator: measure within its limits, identify, judge.

    It goes on where it was stopped.

    Args:
        experiment: Experiment file that gives device and limits.
        output: Model file to write.
        folder: Where each run is kept; ``OUTPUT-runs`` where None.
        settings: Over the experiment.
        highest_hz: Highest frequency of loops; from the sample rate where None.
        fast: Do not wait for real time; simulated devices only.
        overwrite: Whether to begin anew where runs stand.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Raises:
        InputError: Something can't be used or written; nothing has moved.
        RunError: A step ended by a fault; those before it stand.
    """
    from hilctl.base.files import check_writable
    from hilctl.characterise.session import Campaign, CampaignHost
    from hilctl.run.step import paced, unpaced

    file, chosen = Path(output), runs_folder(output, folder)
    host = CampaignHost(run=unpaced if fast else paced, on_progress=on_progress)
    found = Campaign(Path(experiment), texts_of(settings), chosen, highest_hz, host)
    check_writable(file, overwrite=overwrite)
    if overwrite:
        found.discard()
    return found.characterise(file, overwrite=overwrite)


def campaign(
    file: PathLike,
    folder: PathLike | None = None,
    *,
    settings: Settings = (),
    fast: bool = False,
    scheduler: str = "none",
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> "SeriesResult":
    """Run an experiment again and again with other values of its keys; goes on where it was.

    Args:
        file: Campaign file (YAML).
        folder: Where recordings, table and page go; one named after the campaign where None.
        settings: Over the experiment of every step.
        fast: Do not wait for real time; simulated devices only.
        scheduler: With ``fast``, where steps run: ``none``, ``processes``, or a Dask address.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Raises:
        InputError: Something can't be used; nothing has moved.
        RunError: A danger to device or rig ended it; what stands is kept.
    """
    from hilctl.campaign.fast import planned_fast, run_fast
    from hilctl.campaign.folder import campaign_folder
    from hilctl.campaign.session import SeriesHost, planned_in_real_time, prepared, run_series
    from hilctl.campaign.steps import load_campaign

    if scheduler != "none" and not fast:
        raise InputError(
            "scheduler: for fast runs only; those that keep real time follow each other"
        )
    steps = load_campaign(Path(file), texts_of(settings))
    chosen = path_or_none(folder) or campaign_folder(steps)
    host = replace(SeriesHost(), on_progress=on_progress)
    with prepared(chosen, host):
        if fast:
            return run_fast(planned_fast(steps, chosen), host, scheduler)
        return run_series(planned_in_real_time(steps, chosen, host.now_s()), host)
