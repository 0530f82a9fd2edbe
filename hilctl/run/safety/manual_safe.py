"""``hilctl safe``: set devices to their safe values without a run."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.axes import axis_documents, of_each_axis, with_settings
from hilctl.base.device import Device
from hilctl.base.errors import ConfigError, ConfigProblem, HilctlError, RunError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document, load_document
from hilctl.experiment.devices import made_device
from hilctl.experiment.sections.safe import Safe
from hilctl.loop.safe_output import OutputState, SafeGoal, SafeOutput, drive_to_safe
from hilctl.run.processes import GuardianRelief
from hilctl.run.run_folder import DeviceLocks, OutputPlace

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SafeResult:
    """Result of setting the safe value of one axis."""

    device: str
    value: float
    unit: str
    output: OutputState
    error: str  # why it is not confirmed; may be empty
    guardian_active: bool = False  # whether the guardian of an earlier run continues

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return {
            "device": self.device,
            "safe_value": self.value,
            "unit": self.unit,
            "output_safe": self.output == "confirmed",
            "output_state": self.output,
            "error": self.error,
            "guardian_active": self.guardian_active,
        }


def put_safe(
    path: Path,
    settings: Sequence[str],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> dict[str, SafeResult]:
    """Set the devices of an experiment to its safe values, without a ramp; Ctrl-C ends it.

    Only these sections of the file are validated. A guardian of an earlier run leaves the devices
    to this command, and acts again if a device does not confirm.

    Returns:
        The result of each axis by name; that of an experiment without axes under "".

    Raises:
        InputError: The file is not valid, or a run holds a device; nothing was sent.
    """
    document = with_settings(load_document(path), settings)
    parts = axis_documents(document)
    axes = of_each_axis(parts, lambda _, part: _device_and_value(path, part))
    outputs = list[SafeOutput]()
    infos = [device.info for device, _ in axes.values()]
    places = [OutputPlace(info.holds, info.output) for info in infos]
    holds = list(dict.fromkeys(name for info in infos for name in info.holds))
    with ExitStack() as stack:
        # Refused while a run holds a device: its loop would overwrite the safe value.
        relief = _taken_over(stack, holds, places)
        began_s = clock()
        for (device, value), place in zip(axes.values(), places, strict=True):
            # Without a lock another process may have sent commands.
            unanswered = relief is None or relief.unanswered(place)
            goal, note = SafeGoal(value, 1.0, None, unanswered), _note(relief, place)
            outputs.append(SafeOutput(device, goal, began_s, clock, note))
            stack.callback(_close, device)
        with suppress(KeyboardInterrupt):
            drive_to_safe(outputs, sleep)
        guarded = False
        if relief is not None:
            if all(each.report.final for each in outputs):
                relief.relieve()
            else:
                relief.restart()
                guarded = bool(relief.runs)
    return {
        name: SafeResult(
            device=info.description,
            value=value,
            unit=info.command_unit,
            output=output.report.state,
            error=output.report.error,
            guardian_active=guarded,
        )
        for (name, (_, value)), info, output in zip(axes.items(), infos, outputs, strict=True)
    }


def _device_and_value(path: Path, document: Document) -> tuple[Device, float]:
    """Return the device of an axis, not open, and its safe value."""
    safe = document.validate(Safe, at=("safe",)) if "safe" in document.data else Safe()
    device = made_device(document, path.parent, TextFiles())
    if device is None:
        raise ConfigError([ConfigProblem(str(path), "device", "is required, with a key kind")])
    return device, safe.value


def _note(relief: GuardianRelief | None, output: OutputPlace) -> Callable[[float, bool], None]:
    return lambda value, unanswered: relief.note_write(output, value) if relief else None


def _taken_over(
    stack: ExitStack, holds: Sequence[str], outputs: Sequence[OutputPlace]
) -> GuardianRelief | None:
    """Take devices over until the end of a stack; return the relief of their guardians.

    None if the locks cannot be created, such as in a full /dev/shm.
    """
    try:
        relief = GuardianRelief(outputs)
        # Another user must not prevent the safe value.
        relief.acquire(stack.enter_context(DeviceLocks(holds, take_over=True)))
    except RunError as error:  # the outputs must become safe nevertheless
        _log.warning("%s: the safe value is written anyway", error)
        return None
    return relief


def _close(device: Device) -> None:
    """Close a device; an error changes nothing in what it has confirmed."""
    try:
        device.close()
    except HilctlError as error:
        _log.warning("%s", error)
