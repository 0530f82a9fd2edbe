"""Write a first experiment for a device."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hilctl.api.given import PathLike, Settings, path_or_none, texts_of
from hilctl.base.device import DeviceInfo
from hilctl.base.files import already_there, write_text
from hilctl.base.types import CommandUnit
from hilctl.experiment.examples import copy_schema
from hilctl.experiment.template import starting_device, starting_experiment


@dataclass(frozen=True, slots=True)
class WrittenExperiment:
    """What :func:`init` has written.

    Attributes:
        path: Experiment file.
        schema: Schema beside it, by which editors check it.
        title: The device, for people.
        device: What the device says of itself.
        to_be_set: Dotted keys that only the owner of the rig can know and no setting gives, each
            with what it is; the values that stand there are nobody's.
    """

    path: Path
    schema: Path
    title: str
    device: "DeviceInfo"
    to_be_set: Mapping[str, str]


def init(
    device: str,
    output: PathLike | None = None,
    *,
    unit: "CommandUnit" = "A",
    reader: str | None = None,
    settings: Settings = (),
) -> WrittenExperiment:
    """Write a first experiment for a device, small, slow and explained; :func:`check` accepts it.

    Args:
        device: Device, shipped profile, or path of a profile of your own.
        output: Experiment file to write; ``DEVICE.yaml`` in this folder where None.
        unit: What drives the actuator, current (``A``) or voltage (``V``).
        reader: Profile of the device that reads the sensor, where it is another one.
        settings: Over the experiment.

    Raises:
        InputError: There is no such device, the file is there already, or with these settings it
            may not start; nothing was written.
    """
    path, texts = path_or_none(output) or default_path(device), texts_of(settings)
    refuse_existing(path)
    begun = starting_device(device, path.parent, unit, reader)
    text, info = starting_experiment(begun, path, texts)
    write_text(path, text, overwrite=False)
    left = {key: asked for key, asked in begun.asked.items() if not is_set(key, texts)}
    return WrittenExperiment(path, copy_schema(path.parent), begun.title, info, left)


def default_path(device: str) -> Path:
    """Return where the experiment for a device goes when nobody says."""
    return Path(f"{Path(device).stem}.yaml")


def refuse_existing(path: Path) -> None:
    """Refuse a file that is there: somebody's own values stand in it.

    Raises:
        InputError: It is.
    """
    if path.exists():
        raise already_there(path, "give another name with --output")


def is_set(key: str, texts: list[str]) -> bool:
    """Return whether ``key=value`` texts give a key, or what is around it."""
    given = (each.partition("=")[0].strip() for each in texts)
    return any(key == each or key.startswith(f"{each}.") for each in given)
