"""What the last run of a device left in its actuator and its coil, where a recording says so.

The newest recording of the same device in the folders that runs are written to is taken, or none:
an older one would leave out what came after it. A device is the same by what it holds alone while
it is open; simulated ones hold nothing, and begin at rest whenever they are made.
"""

import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.experiment.file import Experiment
from hilctl.experiment.heat import CoilHeat, cooled
from hilctl.experiment.initial_state import InitialState, initial_state_after
from hilctl.experiment.load import LoadedExperiment
from hilctl.recording.ends import read_ends, recordings_in
from hilctl.recording.facts import HEAT_FACT, HOLDS_FACT

_LARGEST_BYTES = 256 << 20  # some minutes at 50 kHz: more would keep the start waiting


def left_by_last_run(
    loaded: LoadedExperiment, now_s: float, folder: Path | None = None
) -> tuple[InitialState | None, str]:
    """Return where the last run left the actuator, or None for rest; and which, or why, in words.

    Args:
        loaded: The experiment; it has a compensator.
        now_s: Unix time in s.
        folder: Folder that this run is written to, where that is not ``recording.folder``.

    Raises:
        ModelError: The model has no inverse.
    """
    config, model, holds = loaded.config, loaded.model, loaded.device.info.holds
    if not holds or model is None:
        return None, "at rest"
    folders = _folders(config, folder)
    path = _newest(folders, holds)
    if path is None:
        where = " and ".join(str(each) for each in folders)
        return None, f"at rest: no recording of this device in {where}"
    try:
        left, why = None, f"{path}: is larger than {_LARGEST_BYTES >> 20} MB"
        if path.stat().st_size <= _LARGEST_BYTES:
            left = initial_state_after(path, model, config.sample_rate_hz, now_s)
    except (DataError, OSError) as error:
        left, why = None, str(error)
    if left is None:
        return None, f"at rest, what the last run left is not known: {why}"
    return left, f"where {path} left the actuator"


def heat_before(loaded: LoadedExperiment, folder: Path | None, now_s: float) -> float:
    """Return what the last run has left of the coil's heat, in A^2; that of the safe value, if any.

    Args:
        loaded: The experiment.
        folder: Folder that this run is written to, where that is not ``recording.folder``.
        now_s: Unix time in s.
    """
    config, holds = loaded.config, loaded.device.info.holds
    rest_a2 = config.safe.value**2
    if not holds or config.limits.thermal_time_constant_s is None:
        return rest_a2
    path = _newest(_folders(config, folder), holds)
    return rest_a2 if path is None else heat_after(path, config, now_s)


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
    budget_a2 = (config.limits.rms_current_a or 0.0) ** 2
    try:
        heat_a2, ended_s = _heat_at_end(path, config)
    except (DataError, OSError, ValueError):
        heat_a2, ended_s = budget_a2, _changed_s(path, now_s)
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


def _folders(config: Experiment, folder: Path | None) -> list[Path]:
    return [*dict.fromkeys([Path(config.recording.folder), *([folder] if folder else [])])]


def _newest(folders: Sequence[Path], holds: Sequence[str]) -> Path | None:
    """Return the newest recording of a device in some folders."""
    aged = []
    for path in (path for folder in folders for path in recordings_in(folder)):
        try:
            aged.append((path.stat().st_mtime_ns, path))
        except OSError:  # it has gone meanwhile
            continue
    for _, path in sorted(aged, reverse=True):
        try:
            facts = read_ends(path).run
        except DataError:  # not one of hilctl, or without a beginning
            continue
        if facts.get(HOLDS_FACT) == json.dumps(list(holds)):
            return path
    return None
