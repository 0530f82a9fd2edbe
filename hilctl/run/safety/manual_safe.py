"""``hilctl safe``: set a device to its safe value without a run."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.axes import one_axis_document, with_settings
from hilctl.base.device import Device
from hilctl.base.errors import ConfigError, ConfigProblem, HilctlError, RunError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import load_document
from hilctl.experiment.devices import made_device
from hilctl.experiment.sections.safe import Safe
from hilctl.loop.safe_output import (
    PATIENCE_S,
    LocalError,
    OutputState,
    SafeGoal,
    SafeOutput,
)
from hilctl.run.processes import GuardianRelief
from hilctl.run.run_folder import DeviceLocks

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SafeResult:
    """Result of setting the safe value."""

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
) -> SafeResult:
    """Set the device of an experiment to the experiment's safe value, without a ramp.

    Only these sections of the file are validated. A guardian of an earlier run leaves the device
    to this command, and acts again if the device does not confirm.

    Raises:
        InputError: The file is not valid, or a run holds the device; nothing was sent.
    """
    document = one_axis_document(with_settings(load_document(path), settings))
    given = "safe" in document.data
    safe = document.validate(Safe, at=("safe",)) if given else Safe()
    device = made_device(document, path.parent, TextFiles())
    if device is None:
        raise ConfigError([ConfigProblem(str(path), "device", "is required, with a key kind")])
    info = device.info
    with ExitStack() as stack:
        # Refused while a run holds the device: its loop would overwrite the safe value.
        died, relief = _taken_over(stack, info.holds)
        goal = SafeGoal(safe.value, 1.0, None, pending=died)
        output = SafeOutput(device, goal, clock, relief.note_write)
        stack.callback(_close, device)
        _drive(output, clock, sleep)
        if output.final:
            relief.relieve()
        else:
            relief.restart()
    return SafeResult(
        device=info.description,
        value=safe.value,
        unit=info.command_unit,
        output=output.state,
        error=output.error,
        guardian_active=bool(relief.runs) and not output.final,
    )


def _taken_over(stack: ExitStack, holds: Sequence[str]) -> tuple[bool, GuardianRelief]:
    """Take a device over until the end of a stack, without locks if they cannot be created.

    Return whether a run of it died, which may have left an unanswered command, and the relief of
    its guardian.
    """
    died, relief = True, GuardianRelief(())
    try:
        relief = GuardianRelief(holds)
        died = relief.found
        # Another user must not prevent the safe value.
        relief.acquire(stack.enter_context(DeviceLocks(holds, take_over=True)))
    except RunError as error:  # such as a full /dev/shm: the output must become safe nevertheless
        _log.warning("%s: the safe value is written anyway", error)
    return died, relief


def _close(device: Device) -> None:
    """Close a device; an error changes nothing in what it has confirmed."""
    try:
        device.close()
    except HilctlError as error:
        _log.warning("%s", error)


def _drive(output: SafeOutput, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
    """Write until the state is final or set, a time limit, or Ctrl-C."""
    give_up_s = clock() + PATIENCE_S
    with suppress(KeyboardInterrupt):
        while True:
            try:
                output.attempt()
            except LocalError as error:
                output.error = str(error)
            if output.final or output.state == "set" or clock() >= give_up_s:
                return
            sleep(output.pause_s)
