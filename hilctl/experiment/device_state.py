"""The state that the last run of an output left: memory of the actuator, heat of the coil.

A file names the run (:mod:`hilctl.experiment.state_files`), so that copying or recovering an old
recording does not change which run was the last. Simulated devices have no file and start at rest.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

from hilctl.base.errors import ConfigProblem, DataError, InputError, broken
from hilctl.base.samples import Flag
from hilctl.base.types import F64
from hilctl.experiment.coil_heat import CoilHeat, cooled
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.sections.compensator import CompensatorStart, InitialState, begin, left_by
from hilctl.experiment.sections.coupling import coupling_sha256
from hilctl.experiment.sections.limits import Limits
from hilctl.experiment.state_files import (
    CoilState,
    LastRun,
    MachineTime,
    last_runs,
    names_of,
    state_of_run,
    write_state,
)
from hilctl.models.base import HysteresisModel
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.run_summary import read_ends
from hilctl.waveforms.build import Reference


def start_of(
    loaded: LoadedExperiment,
    reference: Reference,
    conditioned: F64,
    now: MachineTime,
    crosstalk_um: F64 | None = None,
) -> tuple[CompensatorStart, list[ConfigProblem]]:
    """Return input and initial state of the compensator, and the problems if one is unknown.

    ``conditioned``, float64[m], are the commands before the waveform, and ``crosstalk_um``,
    float64[n], is subtracted from the input. Raise ModelError if the model has no inverse.
    """
    config = loaded.config
    problems: list[ConfigProblem] = []
    values = reference.values
    try:
        values = corrected_um(loaded, reference)
    except InputError as error:
        hint = "learn again with 'hilctl learn', or remove it"
        problems.append(broken("compensator.correction", str(error), hint=hint))
    if crosstalk_um is not None:
        values = values - crosstalk_um
    before, begins = None, ""
    try:
        before, begins = _state_before(loaded, conditioned, now)
    except DataError as error:
        problems.append(broken("compensator.initial_state", str(error)))
    if before is not None:
        # With a soft start of this length, it becomes one from where the actuator stands.
        soft = reference.segments[0].steady_start
        values = before.lead_in(values, max(loaded.rig.lead_in_samples, soft))
    last = reference.segments[-1]
    begun = begin(loaded.model, config.sample_rate_hz, values, before, begins, last)
    if config.zero and loaded.model is None:
        return replace(begun, stands_um=0.0), problems
    known = config.zero or config.measures_offset
    return (begun if known else replace(begun, stands_um=None)), problems


def corrected_um(loaded: LoadedExperiment, reference: Reference) -> F64:
    """Return a reference with its learned correction, if the experiment has one: float64[n].

    Raise InputError if the correction belongs to another rate, model, waveform or coupling.
    """
    if loaded.correction is None:
        return reference.values
    if loaded.correction.coupling_sha256 != coupling_sha256(loaded.coupling):
        raise InputError("was learned without this coupling: it contains another crosstalk")
    return loaded.correction.added(reference, loaded.model)


def _state_before(
    loaded: LoadedExperiment, conditioned: F64, now: MachineTime
) -> tuple[InitialState | None, str]:
    """Return the actuator's state before the waveform (None at rest) and its origin in words.

    Raise DataError if the recording that the experiment names does not tell it.
    """
    config, model = loaded.config, loaded.model
    if model is None or config.compensator is None:
        return None, ""
    rate_hz, named = config.sample_rate_hz, config.compensator.initial_state
    before, begins = None, "at rest"
    if config.condition is not None:
        begins = "where its condition leaves the actuator"
    elif named == "last":
        before, begins = left_by_last_run(loaded, now)
    elif named != "rest":
        begins = f"where {named} left the actuator"
        path = loaded.folder / named
        before = initial_state_after(path, model, rate_hz, now.unix_s, config.safe.value)
    if before is None and conditioned.size:
        before = left_by([conditioned], model, rate_hz)
    return before, begins


def initial_state_after(
    path: Path, model: HysteresisModel, sample_rate_hz: float, now_s: float, safe: float
) -> InitialState:
    """Return the state of the actuator after a recorded run that began at rest.

    The model converts all of its commands to displacements, and the inverse follows those, so the
    run may have used any compensator or none. The output then moves to ``safe``, the safe value
    of the next run. Creep decays from the end of the run to ``now_s``, a Unix time, for at least
    one second.

    Raises:
        DataError: The recording is unreadable or incomplete, or its commands do not fit.
        ModelError: The model has no inverse.
    """
    ends, ended_s = read_ends(path), math.inf
    with suppress(ValueError):  # absent in old recordings: one second is simulated
        ended_s = _unix_s(ends.end.get("ended", ""))
    commands = chain(_recorded_commands(path, model.input_unit, sample_rate_hz), [np.array([safe])])
    left = left_by(commands, model, sample_rate_hz, now_s - ended_s)
    if not math.isfinite(left.stands_um):
        raise DataError(f"{path}: has commands beyond the range of the model")
    return replace(left, run_id=ends.run.get("run_id", ""))


def _recorded_commands(path: Path, unit: str, sample_rate_hz: float) -> Iterator[F64]:
    """Yield the commands of a complete recorded run in order, then its safe value.

    The output is constant in skipped ticks.
    """
    samples, held, last, whole, unanswered = 0, 0, 0.0, True, False
    for piece in RecordingStream(path):
        if piece.command_unit != unit:
            units = f"{piece.command_unit}, the model takes {unit}"
            raise DataError(f"{path}: was recorded in {units}")
        if piece.sample_rate_hz != sample_rate_hz:
            rates = f"{piece.sample_rate_hz:g} Hz, this run is at {sample_rate_hz:g} Hz"
            raise DataError(f"{path}: was recorded at {rates}")
        index, flags, command = piece.samples.index, piece.samples.flags, piece.samples.command
        unanswered |= bool(np.any(flags & Flag.UNANSWERED.value))
        if not index.size:
            continue
        gaps = np.diff(index, prepend=samples - 1) - 1
        skipped = bool(np.all(flags[gaps > 0] & Flag.AFTER_SKIPPED.value))
        whole &= skipped and (samples > 0 or index[0] == 0)
        held += int(gaps.sum())
        yield np.full(gaps[0], last)
        yield np.repeat(command, 1 + np.append(gaps[1:], 0))
        samples, last = int(index[-1]) + 1, float(command[-1])
    if not (whole and samples and piece.end) or piece.dropped > held:
        raise DataError(f"{path}: is incomplete: the state of the actuator is unknown")
    if unanswered or piece.end.get("output_safe") == "false":
        lost = "lost its device, or did not confirm its safe value"
        raise DataError(f"{path}: {lost}: the state of the actuator is unknown")
    if "safe_value" in piece.run:  # the guardian's, if it took over, is not a sample
        yield np.array([float(piece.run["safe_value"])])


_LARGEST_BYTES = 256 << 20  # some minutes at 50 kHz: more would delay the start
_LITTLE = 1e-3  # of the thermal budget


def left_by_last_run(loaded: LoadedExperiment, now: MachineTime) -> tuple[InitialState | None, str]:
    """Return the actuator's state after the last run (None at rest) and its origin in words.

    Raises:
        ModelError: The model has no inverse.
    """
    config, model, info = loaded.config, loaded.model, loaded.device.info
    if model is None or not names_of(info):
        return None, "at rest"
    runs = last_runs(info)
    if not runs:
        return None, "at rest: no earlier run of this device is known"
    last = max(runs, key=lambda run: run.order(now))
    try:
        path = _recording_of(last)
        now_s = last.ended_s + last.since_s(now)
        left = initial_state_after(path, model, config.sample_rate_hz, now_s, config.safe.value)
    except (DataError, OSError) as error:
        return None, f"at rest, because the state after the last run is unknown: {error}"
    return left, f"where {path} left the actuator"


def _recording_of(run: LastRun) -> Path:
    """Return the recording of a run; raise DataError if it is unknown, too large, or another."""
    if run.state is None:
        raise DataError(f"{run.path}: is damaged or of a newer version: remove it if all is cold")
    path = Path(run.state.recording)
    if read_ends(path).run.get("run_id") != run.state.run_id:
        raise DataError(f"{path}: is no longer the recording of the last run")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")
    return path


def heat_before(loaded: LoadedExperiment, now: MachineTime) -> tuple[float, tuple[str, ...]]:
    """Return the heat in the coil, in A^2, and a note if it is unknown.

    It is the highest that a last run may have left, and at least that of the safe value. An unknown
    one is the thermal budget, which has decayed since the end of that run.
    """
    config, info = loaded.config, loaded.device.info
    rest, tau_s = config.safe.value, config.limits.thermal_time_constant_s
    found, budget_a2 = [(rest**2, "")], _budget_a2(config)
    for run in last_runs(info) if tau_s is not None else ():
        try:
            heat_a2, why = _heat_left(run, config.limits), ""
        except (DataError, OSError, ValueError) as error:
            heat_a2, why = budget_a2, str(error)
        found.append((cooled(heat_a2, rest, tau_s, run.since_s(now)), why))
    heat_a2, why = max(found)
    if not why or heat_a2 - rest**2 < _LITTLE * budget_a2:
        return heat_a2, ()
    text = "the coil's heat is unknown, and taken as its full budget at the end of the last run"
    return heat_a2, (f"{text}: {why}",)


def _heat_left(run: LastRun, limits: Limits) -> float:
    """Return the heat at the end of a run; raise an error if it is unknown."""
    coil = run.state.coil if run.state else None
    if coil is None or (
        coil.output_safe and coil.thermal_time_constant_s != limits.thermal_time_constant_s
    ):
        return _heat_at_end(_recording_of(run), limits)[0]
    if not coil.output_safe:
        raise DataError(f"{run.path}: the safe value was not confirmed after the last run")
    return coil.heat_a2


def _budget_a2(config: Experiment) -> float:
    return (config.limits.rms_current_a or 0.0) ** 2


def finish_state(recording: Path, now: MachineTime) -> None:
    """Write the state that a killed run left, from its recovered recording."""
    with suppress(DataError, OSError, ValueError):  # it stays unknown
        run = read_ends(recording).run
        state = state_of_run(run.get("run_id", ""))
        if state is None or state.coil is not None:
            return
        if state.boot == now.boot:  # it has ended before now
            state = state.model_copy(update={"boot_s": min(state.boot_s, now.boot_s)})
            write_state(state)
        limits = Limits.model_validate_json(run.get("limits", ""), strict=False)
        heat_a2, ended_s = _heat_at_end(recording, limits)
        coil = CoilState(
            ended=datetime.fromtimestamp(ended_s, UTC),
            output_safe=True,
            heat_a2=heat_a2,
            thermal_time_constant_s=limits.thermal_time_constant_s,
        )
        write_state(state.model_copy(update={"coil": coil}))


def heat_after(path: Path, config: Experiment, now_s: float) -> float:
    """Return the coil's heat left by a recorded run, in A^2, with the limits of ``config``.

    It is in the recording, or computed from the samples if the supervisor was killed. If those
    cannot be read, or the safe value was not confirmed, the full thermal budget is assumed.
    ``now_s`` is a Unix time.
    """
    rest = config.safe.value
    try:
        heat_a2, ended_s = _heat_at_end(path, config.limits)
    except (DataError, OSError, ValueError):
        heat_a2, ended_s = _budget_a2(config), _changed_s(path, now_s)
    tau_s = config.limits.thermal_time_constant_s
    return max(rest**2, cooled(heat_a2, rest, tau_s, now_s - ended_s))


def _heat_at_end(path: Path, limits: Limits) -> tuple[float, float]:
    """Return the heat at the end of a run, in A^2, and the Unix time of that end in s.

    Raise DataError, OSError or ValueError if it is unknown.
    """
    ends = read_ends(path)
    run, end = ends.run, ends.end
    completed = str(end.get("code") == "completed").lower()
    if end.get("output_safe", completed) != "true":
        raise DataError(f"{path}: the run has no known end, or did not confirm its safe value")
    recorded = json.loads(run.get("limits", "{}"))
    same = recorded.get("thermal_time_constant_s") == limits.thermal_time_constant_s
    if same and HEAT_FACT in end and "ended" in end:
        return _finite(end), _unix_s(end["ended"])
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES >> 20} MB")
    recording = read(path)
    rate_hz, samples = recording.sample_rate_hz, recording.samples
    heat = CoilHeat(limits, rate_hz, _finite(run) if HEAT_FACT in run else 0.0)
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
