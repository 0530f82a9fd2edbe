"""What the last run of a device left in its actuator and its coil.

The device's state says which run that was, see :mod:`hilctl.experiment.device_state`; the commands
in its recording say where they left the actuator, by whatever model. Simulated devices have no
state, and begin at rest whenever they are made.
"""

import json
import math
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.experiment.coil_heat import CoilHeat, cooled
from hilctl.experiment.device_state import DeviceState, read_device_state
from hilctl.experiment.file import Experiment
from hilctl.experiment.initial_state import InitialState, initial_state_after
from hilctl.experiment.load import LoadedExperiment
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.run_summary import read_ends

_LARGEST_BYTES = 256 << 20  # some minutes at 50 kHz: more would keep the start waiting


def left_by_last_run(loaded: LoadedExperiment, now_s: float) -> tuple[InitialState | None, str]:
    """Return where the last run left the actuator, or None for rest; and which, or why, in words.

    Args:
        loaded: The experiment; it has a compensator.
        now_s: Unix time in s.

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
        return None, f"at rest, what the last run left is not known: {error}"
    return left, f"where {path} left the actuator"


def _check_run(state: DeviceState) -> None:
    """Raise DataError unless the recording is that of the last run, and not too large."""
    path = Path(state.recording)
    if read_ends(path).run.get("run_id") != state.run_id:
        raise DataError(f"{path}: is not the recording of the last run any more")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")


def heat_before(loaded: LoadedExperiment, now_s: float) -> float:
    """Return what the last run has left of the coil's heat, in A^2; that of the safe value, if any.

    Args:
        loaded: The experiment.
        now_s: Unix time in s.
    """
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
        if not coil.output_safe:  # it may have been driven on
            heat_a2 = _budget_a2(config)
    return max(rest**2, cooled(heat_a2, rest, tau_s, now_s - ended_s))


def _budget_a2(config: Experiment) -> float:
    return (config.limits.rms_current_a or 0.0) ** 2


def _last_seen_s(state: DeviceState) -> float:
    """Return the latest time at which a run whose recording cannot be read may have gone on."""
    if state.coil is not None:
        return state.coil.ended.timestamp()
    path = Path(state.recording)
    # Of a file that was removed or replaced, its folder tells when.
    return max(state.started.timestamp(), *(_changed_s(each, 0.0) for each in (path, path.parent)))


def heat_after(path: Path, config: Experiment, now_s: float) -> float:
    """Return what a recorded run has left of the coil's heat, in A^2.

    Where its recording does not say it, for its supervisor was killed, it is worked out from the
    samples. Where those can't be read, or the output was not seen to become safe, the coil is taken
    to have been as hot as its budget allows.

    Args:
        path: The recording.
        config: Experiment whose budget counts: current limit, time constant, safe value.
        now_s: Unix time in s.
    """
    rest = config.safe.value
    try:
        heat_a2, ended_s = _heat_at_end(path, config)
    except (DataError, OSError, ValueError):
        heat_a2, ended_s = _budget_a2(config), _changed_s(path, now_s)
    tau_s = config.limits.thermal_time_constant_s
    return max(rest**2, cooled(heat_a2, rest, tau_s, now_s - ended_s))


def _heat_at_end(path: Path, config: Experiment) -> tuple[float, float]:
    """Return the heat at the end of a run, in A^2, and when that was, Unix time in s."""
    ends = read_ends(path)
    run, end = ends.run, ends.end
    limits = json.loads(run.get("limits", "{}"))
    same = limits.get("thermal_time_constant_s") == config.limits.thermal_time_constant_s
    if not end.get("output_safe", "true") == "true":
        raise DataError(f"{path}: did not confirm its safe value: the coil may be hot still")
    if same and HEAT_FACT in end and "ended" in end:
        return _finite(end), _unix_s(end["ended"])
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")
    from hilctl.recording.reader import read  # what it takes to import, most runs would wait for

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
