"""A device put at its safe value by hand, with no run."""

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import ConfigError, DeviceError, Problem, RunError
from hilctl.base.files import TextFiles
from hilctl.base.yaml.document import load_document
from hilctl.experiment.device import made_device
from hilctl.experiment.file import Safe
from hilctl.run.run_folder import held_devices

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SafeByHand:
    """What came of it.

    Attributes:
        device: The device, for people.
        value: The safe value.
        unit: Its unit, ``A`` or ``V``.
        error: Why it could not be confirmed; empty where the device confirmed it.
    """

    device: str
    value: float
    unit: str
    error: str

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return {
            "device": self.device,
            "safe_value": self.value,
            "unit": self.unit,
            "output_safe": not self.error,
            "error": self.error,
        }


def put_safe(path: Path, settings: Sequence[str]) -> SafeByHand:
    """Put the device of an experiment at the experiment's safe value, at once and without a ramp.

    Nothing else of the file is needed, and so nothing else of it can be in the way.

    Args:
        path: Experiment file.
        settings: ``key=value`` texts over it.

    Raises:
        InputError: The file can't be used, or a run holds the device. Nothing was sent.
    """
    document = load_document(path)
    for setting in settings:
        document.set(setting)
    given = "safe" in document.data
    safe = document.validate(Safe, at=("safe",)) if given else Safe()
    device = made_device(document, path.parent, TextFiles())
    if device is None:
        raise ConfigError([Problem(str(path), "device", "is required, with a key kind")])
    info = device.info
    # Not past a run that holds it: its loop would write over the safe value a tick later.
    with ExitStack() as stack:
        try:
            stack.enter_context(held_devices(info.holds))
        except RunError as raised:  # anybody can fill /dev/shm: no reason to leave current flowing
            _log.warning("%s: the safe value is put out all the same", raised)
        try:
            device.make_safe(safe.value)
            error = ""
        except DeviceError as raised:
            error = str(raised)
    return SafeByHand(info.description, safe.value, info.command_unit, error)
