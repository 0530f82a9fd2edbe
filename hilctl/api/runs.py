"""Write, load, check and run an experiment."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hilctl.api._types import PathLike, experiment_path, path_or_none
from hilctl.base.device import DeviceInfo
from hilctl.base.files import already_there, exists, write_text
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Settings, texts_of
from hilctl.experiment.examples import copy_schema
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
from hilctl.experiment.template import starting_device, starting_experiment
from hilctl.run.result import Progress, RunResult
from hilctl.run.start import checked_experiment, checked_run, output_of, start_run
from hilctl.run.unpaced import run_unpaced


@dataclass(frozen=True, slots=True)
class WrittenExperiment:
    """Result of :func:`init`.

    Attributes:
        path: Experiment file.
        schema: JSON schema in the same folder, for editors.
        title: Title of the device.
        device: Description of the device.
        to_be_set: Dotted keys that depend on the rig and were not set, with the question for each;
            the file contains placeholders.
    """

    path: Path
    schema: Path
    title: str
    device: DeviceInfo
    to_be_set: Mapping[str, str]


def init(
    device: str,
    output: PathLike | None = None,
    *,
    unit: CommandUnit = "A",
    reader: str | None = None,
    settings: Settings = (),
) -> WrittenExperiment:
    """Write a first experiment for a device: small, slow and commented; :func:`check` accepts it.

    Args:
        device: Device, shipped profile, or path of a profile.
        output: Experiment file to write; default: ``DEVICE.yaml`` in the working folder.
        unit: Unit of the drive, current (``A``) or voltage (``V``).
        reader: Profile of the device that reads the sensor, if separate.
        settings: Overrides of the experiment.

    Raises:
        InputError: The device is unknown, the file exists, or the settings are invalid; nothing was
            written.
    """
    path, texts = path_or_none(output) or default_path(device), texts_of(settings)
    refuse_existing(path)
    begun = starting_device(device, path.parent, unit, reader, texts)
    text, info = starting_experiment(begun, path, texts)
    write_text(path, text, overwrite=False)
    left = {key: asked for key, asked in begun.asked.items() if not is_set(key, texts)}
    return WrittenExperiment(path, copy_schema(path.parent), begun.title, info, left)


def default_path(device: str) -> Path:
    """Return the default file of an experiment for a device."""
    return Path(f"{Path(device).stem}.yaml")


def refuse_existing(path: Path) -> None:
    """Raise :class:`hilctl.base.errors.InputError` if a file exists."""
    if exists(path):
        raise already_there(path, "choose another output")


def is_set(key: str, texts: list[str]) -> bool:
    """Return whether ``key=value`` texts set a key or a section that contains it."""
    keys = (each.partition("=")[0].strip() for each in texts)
    return any(key == each or key.startswith(f"{each}.") for each in keys)


def load(experiment: PathLike, settings: Settings = ()) -> LoadedExperiment:
    """Read an experiment with its device and model.

    Args:
        experiment: Experiment file (YAML).
        settings: Overrides of the experiment.

    Raises:
        InputError: The experiment is invalid; the error lists all problems.
    """
    return load_experiment(experiment_path(experiment), texts_of(settings))


def check(experiment: PathLike, settings: Settings = ()) -> CheckedExperiment:
    """Check an experiment against device, model and limits, as each run does; nothing moves.

    Args:
        experiment: Experiment file (YAML).
        settings: Overrides of the experiment.

    Raises:
        InputError: The experiment cannot run; the error lists all problems.
    """
    return checked_experiment(experiment_path(experiment), texts_of(settings))


def check_axes(experiment: PathLike, settings: Settings = ()) -> CheckedRun:
    """Check an experiment with one axis or several, see :func:`check`; nothing moves.

    Args:
        experiment: Experiment file (YAML).
        settings: Overrides of the experiment; ``axis=NAME`` chooses one axis.

    Returns:
        The checked axes, in ``axes``, and notes on them together.

    Raises:
        InputError: The experiment cannot run; the error lists all problems.
    """
    return checked_run(experiment_path(experiment), texts_of(settings))


def run(
    experiment: PathLike,
    output: PathLike | None = None,
    *,
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    take_over: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> RunResult:
    """Run an experiment and record it; SIGINT and SIGTERM ramp to the safe value first.

    It may be called in any thread. If there are other threads, the run has its own process, and
    signals are forwarded to it if the caller is the main thread.

    Args:
        experiment: Experiment file (YAML).
        output: Recording to write; default: a new name in the experiment's folder.
        settings: Overrides of the experiment.
        fast: Simulate without waiting; simulated devices only, any computer.
        overwrite: Replace an existing recording.
        take_over: Use the device even if another user's process holds it.
        on_progress: Called with each batch of samples of a run in real time.

    Returns:
        The result; ``path`` is the recording. A fault is a result, not an error.

    Raises:
        InputError: The experiment cannot run; nothing has moved, and no file is left.
        RunError: The device could not be opened; nothing has moved, and no file is left.
    """
    path, texts, chosen = experiment_path(experiment), texts_of(settings), path_or_none(output)
    if not fast:
        return start_run(path, texts, chosen, overwrite, on_progress, take_over=take_over)
    checked = checked_run(path, texts)
    return run_unpaced(checked, output_of(checked, chosen), overwrite=overwrite)
