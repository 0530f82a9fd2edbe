"""The last run of each device and the state it left: memory of the actuator, heat of the coil.

One small file per device names the run. It is in the user's state folder (``XDG_STATE_HOME``), so
that copying or recovering an old recording does not change which run was the last. It is written
when a run begins and again when the run ends. Simulated devices have no file and start at rest.
"""

import hashlib
import json
import logging
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import read_text, write_text
from hilctl.base.strict import Field, StrictModel, ValidationError
from hilctl.experiment.coil_heat import CoilHeat, cooled
from hilctl.experiment.file import Experiment
from hilctl.experiment.initial_state import InitialState, initial_state_after
from hilctl.experiment.load import LoadedExperiment
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.run_summary import read_ends

_log = logging.getLogger(__name__)


class CoilState(StrictModel):
    """State of the coil after a run."""

    ended: datetime  # end of the run
    output_safe: bool  # whether the device confirmed its safe value
    heat_a2: Annotated[float, Field(ge=0.0)]  # running mean square of its current, in A^2
    thermal_time_constant_s: float | None  # None without a thermal budget


class DeviceState(StrictModel):
    """The last run of a device."""

    holds: list[str]  # resources of the device, see DeviceInfo.holds
    run_id: str
    recording: str  # absolute path; its commands determine the actuator's state
    started: datetime  # due time of its first sample
    coil: CoilState | None = None  # final state of the coil; None until the run has ended


def read_device_state(holds: Sequence[str]) -> DeviceState | None:
    """Return the state of a device by its resources; None if it has no history."""
    path = _path(holds)
    if path is None or not os.path.lexists(path):
        return None
    try:
        return DeviceState.model_validate_json(read_text(path))
    except (InputError, ValidationError) as error:
        why = error if isinstance(error, InputError) else f"{path}: is damaged"
        _log.warning("%s: assuming that the device is at rest and cold", why)
        return None


def write_device_state(state: DeviceState) -> None:
    """Replace the state of a device; delete the old one if that fails."""
    path = _path(state.holds)
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, state.model_dump_json(), overwrite=True)
    except (InputError, OSError) as error:
        _log.warning("%s: the next run cannot use the final state of this one", error)
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _path(holds: Sequence[str]) -> Path | None:
    """Return the file of a device; None if it has no resources or the user no home folder."""
    given = os.environ.get("XDG_STATE_HOME", "")
    try:
        place = Path(given) if Path(given).is_absolute() else Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    name = hashlib.sha256(json.dumps(list(holds)).encode()).hexdigest()[:32]
    return place / "hilctl" / "devices" / f"{name}.json" if holds else None


_LARGEST_BYTES = 256 << 20  # some minutes at 50 kHz: more would delay the start


def left_by_last_run(loaded: LoadedExperiment, now_s: float) -> tuple[InitialState | None, str]:
    """Return the actuator's state after the last run (None at rest) and its origin in words.

    ``now_s`` is Unix time here and below.

    Raises:
        ModelError: The model has no inverse.
    """
    config, model, holds = loaded.config, loaded.model, loaded.device.info.holds
    if not holds or model is None:
        return None, "at rest"
    state = read_device_state(holds)
    if state is None:
        return None, "at rest: no earlier run of this device is known"
    path = Path(state.recording)
    try:
        _check_run(state)
        left = initial_state_after(path, model, config.sample_rate_hz, now_s)
    except (DataError, OSError) as error:
        return None, f"at rest, because the state after the last run is unknown: {error}"
    return left, f"where {path} left the actuator"


def _check_run(state: DeviceState) -> None:
    """Raise DataError if the recording is too large or not that of the last run."""
    path = Path(state.recording)
    if read_ends(path).run.get("run_id") != state.run_id:
        raise DataError(f"{path}: is no longer the recording of the last run")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")


def heat_before(loaded: LoadedExperiment, now_s: float) -> float:
    """Return the coil's heat left by the last run, in A^2; at least that of the safe value."""
    config, holds = loaded.config, loaded.device.info.holds
    rest, tau_s = config.safe.value, config.limits.thermal_time_constant_s
    state = read_device_state(holds) if tau_s is not None else None
    if state is None:
        return rest**2
    coil = state.coil
    if coil is None or (coil.output_safe and coil.thermal_time_constant_s != tau_s):
        try:
            _check_run(state)
            return heat_after(Path(state.recording), config, now_s)
        except (DataError, OSError):
            heat_a2, ended_s = _budget_a2(config), _last_seen_s(state)
    else:
        heat_a2, ended_s = coil.heat_a2, coil.ended.timestamp()
        if not coil.output_safe:  # the current may have continued
            heat_a2 = _budget_a2(config)
    return max(rest**2, cooled(heat_a2, rest, tau_s, now_s - ended_s))


def _budget_a2(config: Experiment) -> float:
    return (config.limits.rms_current_a or 0.0) ** 2


def _last_seen_s(state: DeviceState) -> float:
    """Return the latest possible end of a run whose recording cannot be read."""
    if state.coil is not None:
        return state.coil.ended.timestamp()
    path = Path(state.recording)
    # The folder's time is that of removing or replacing the file.
    return max(state.started.timestamp(), *(_changed_s(each, 0.0) for each in (path, path.parent)))


def heat_after(path: Path, config: Experiment, now_s: float) -> float:
    """Return the coil's heat left by a recorded run, in A^2, with the limits of ``config``.

    It is in the recording, or computed from the samples if the supervisor was killed. If those
    cannot be read, or the safe value was not confirmed, the full thermal budget is assumed.
    """
    rest = config.safe.value
    try:
        heat_a2, ended_s = _heat_at_end(path, config)
    except (DataError, OSError, ValueError):
        heat_a2, ended_s = _budget_a2(config), _changed_s(path, now_s)
    tau_s = config.limits.thermal_time_constant_s
    return max(rest**2, cooled(heat_a2, rest, tau_s, now_s - ended_s))


def _heat_at_end(path: Path, config: Experiment) -> tuple[float, float]:
    """Return the heat at the end of a run, in A^2, and the Unix time of that end in s."""
    ends = read_ends(path)
    run, end = ends.run, ends.end
    limits = json.loads(run.get("limits", "{}"))
    same = limits.get("thermal_time_constant_s") == config.limits.thermal_time_constant_s
    if not end.get("output_safe", "true") == "true":
        raise DataError(f"{path}: did not confirm its safe value: the coil may still be hot")
    if same and HEAT_FACT in end and "ended" in end:
        return _finite(end), _unix_s(end["ended"])
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")
    from hilctl.recording.reader import read  # slow to import, rarely needed

    recording = read(path)
    rate_hz, samples = recording.sample_rate_hz, recording.samples
    heat = CoilHeat(config.limits, rate_hz, _finite(run) if HEAT_FACT in run else 0.0)
    heat.follow(samples)
    lasted_s = (int(samples.index[-1]) + 1) / rate_hz if samples.index.size else 0.0
    return heat.heat_a2, _unix_s(run["started"]) + lasted_s


def _finite(facts: Mapping[str, str]) -> float:
    value = float(facts[HEAT_FACT])
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{HEAT_FACT} must be a number of A^2 from 0: {facts[HEAT_FACT]!r}")
    return value


def _changed_s(path: Path, otherwise: float) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return otherwise


def _unix_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()
