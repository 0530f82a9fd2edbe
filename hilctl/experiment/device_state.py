"""Which run used a device last, and how hot it left the coil: one small file per device.

The file is in the user's own folder of states (``XDG_STATE_HOME``), not beside the recordings:
copying, restoring or recovering an old recording does not change which run was the last one. It is
written when a run begins, so that a run that never ends is not taken for the one before it, and
again when it ends.
"""

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated

from hilctl.base.errors import InputError
from hilctl.base.files import read_text, write_text
from hilctl.base.strict import Field, StrictModel, ValidationError

_log = logging.getLogger(__name__)


class CoilState(StrictModel):
    """How a run left the coil.

    Attributes:
        ended: When it ended.
        output_safe: Whether its output was confirmed to be at the safe value.
        heat_a2: Running mean square of its current, in A^2.
        thermal_time_constant_s: Time constant of that mean; None where the run had none.
    """

    ended: datetime
    output_safe: bool
    heat_a2: Annotated[float, Field(ge=0.0)]
    thermal_time_constant_s: float | None


class DeviceState(StrictModel):
    """The last run of a device.

    Attributes:
        holds: What the device holds alone while it is open, see
            :attr:`hilctl.base.device.DeviceInfo.holds`.
        run_id: The run.
        recording: Absolute path of its recording, whose commands say where the actuator was left.
        started: When its first sample was due.
        coil: How it left the coil; None until it has ended.
    """

    holds: list[str]
    run_id: str
    recording: str
    started: datetime
    coil: CoilState | None = None


def read_device_state(holds: Sequence[str]) -> DeviceState | None:
    """Return the state of a device; None if it has no history.

    Args:
        holds: What it holds; a device that holds nothing has no history.
    """
    path = _path(holds)
    if path is None or not os.path.lexists(path):
        return None
    try:
        return DeviceState.model_validate_json(read_text(path))
    except (InputError, ValidationError) as error:
        why = error if isinstance(error, InputError) else f"{path}: is damaged"
        _log.warning("%s: the device is taken to be at rest and cold", why)
        return None


def write_device_state(state: DeviceState) -> None:
    """Replace the state of a device; where it cannot be written, no older one is left."""
    path = _path(state.holds)
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, state.model_dump_json(), overwrite=True)
    except (InputError, OSError) as error:
        _log.warning("%s: the next run will not know what this one left", error)
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _path(holds: Sequence[str]) -> Path | None:
    """Return the file of a device; None where it has no history, or its user no home."""
    given = os.environ.get("XDG_STATE_HOME", "")
    try:
        place = Path(given) if Path(given).is_absolute() else Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    name = hashlib.sha256(json.dumps(list(holds)).encode()).hexdigest()[:32]
    return place / "hilctl" / "devices" / f"{name}.json" if holds else None
