"""The state that the last run of an output left: memory of the actuator, heat of the coil.

A compensator starts at rest, or with the memory that earlier commands left. A file names the run
(:mod:`hilctl.experiment.state_files`), so that copying or recovering an old recording does not
change which run was the last. Simulated devices have no file and start at rest.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.experiment.coil_heat import CoilHeat, cooled
from hilctl.experiment.file import Experiment, Limits
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.state_files import (
    CoilState,
    LastRun,
    MachineTime,
    last_runs,
    names_of,
    state_of_run,
    write_state,
)
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel, Operator
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.run_summary import read_ends

_STILL_S = 1.0
_AT_REST_S = 0.1  # after which the stages of any actuator are at rest
_FEWEST_SAMPLES = 16  # which a delay and a preview need at a low rate
_FIRST_STEP_UM = 1e-4
_SETTLED_UM = 1e-9
_MOST_STEPS = 20


@dataclass(frozen=True, slots=True)
class CompensatorStart:
    """Input and initial state of the compensator of a run."""

    input_um: F64  # float64[n], its input; the reference itself if nothing is added
    preview: int  # samples by which its input runs ahead of the commands
    state_size: int  # numbers in its memory
    state: F64 | None = None  # float64[state_size], before the first sample; None at rest
    begins: str = "at rest"  # origin of the initial state in words
    run_id: str = ""  # the run that left this memory; empty if none did
    stands_um: float | None = None  # modelled before the first sample, to measure the offset


@dataclass(frozen=True, slots=True)
class InitialState:
    """State of the actuator after earlier commands."""

    state: F64  # float64[state_size], the compensator's memory
    stands_um: float  # displacement by the model
    run_id: str  # the run of those commands; empty for the present one

    def lead_in(self, input_um: F64, samples: int) -> F64:
        """Return the input, float64[n], led in over ``samples`` from the displacement."""
        away_um = self.stands_um - float(input_um[0])
        led = input_um.copy()
        part = np.arange(min(samples, input_um.size)) / samples
        led[: part.size] += 0.5 * (1.0 + np.cos(np.pi * part)) * away_um
        return led


def begin(
    model: HysteresisModel | None,
    sample_rate_hz: float,
    values: F64,
    before: InitialState | None = None,
    begins: str = "at rest",
    last: Segment | None = None,
) -> CompensatorStart:
    """Return input and initial state of a compensator.

    ``values``, float64[n], is the reference with correction and lead-in, and ``before`` the state
    of the actuator (None at rest) with its origin ``begins`` in words. ``last`` is the last
    waveform, see :meth:`Compensator.ahead`.

    Raises:
        ModelError: The model has no inverse.
    """
    compensator = Compensator(model, sample_rate_hz)
    if before is not None:
        compensator.restore(before.state)
    compensator.begin(values)
    state = compensator.state()
    return CompensatorStart(
        input_um=compensator.ahead(values, last),
        preview=compensator.preview,
        state_size=state.size,
        state=state if before is not None or compensator.preview else None,
        begins=begins,
        run_id=before.run_id if before else "",
        stands_um=before.stands_um if before else None,
    )


def rests_at(model: HysteresisModel, sample_rate_hz: float, command: float) -> float:
    """Return the displacement at rest at a command that was never exceeded, in um."""
    samples = max(round(_AT_REST_S * sample_rate_hz), 1)
    return float(model.forward(sample_rate_hz).process(np.full(samples, command))[-1])


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


def left_by(
    commands: Iterable[F64],
    model: HysteresisModel,
    sample_rate_hz: float,
    stood_s: float | None = None,
) -> InitialState:
    """Return the state of a model after commands from rest, float64[n] each, in order.

    ``stood_s`` is the time since the commands, of which at least one second is simulated;
    without it they must end with a rest.
    """
    forward, inverse = model.forward(sample_rate_hz), model.inverse(sample_rate_hz)
    rest = inverse.state()
    ahead, stands_um, last = inverse.preview, 0.0, 0.0
    still = 0 if stood_s is None else round(_STILL_S * sample_rate_hz)
    for command in _and_still(commands, still):
        came = forward.process(command)
        if not np.isfinite(came).all():
            return InitialState(rest, math.nan, "")
        if came.size > ahead:
            inverse.process(came[ahead:])
        ahead, stands_um, last = max(ahead - came.size, 0), float(came[-1]), float(command[-1])
    if stood_s is not None and (more_s := stood_s - _STILL_S) > 0.0:
        forward.stand(more_s)
        inverse.stand(more_s)
        stands_um = float(forward.process(np.array([last]))[0])
    samples = max(round(_AT_REST_S * sample_rate_hz), _FEWEST_SAMPLES)
    stands_um = _settle(inverse, stands_um, last, samples)
    return InitialState(inverse.state(), stands_um, "")


def _settle(inverse: Operator, near_um: float, command: float, samples: int) -> float:
    """Settle an inverse where it holds a command, near a displacement; return its displacement.

    An inverse is inexact at steps of the command, such as those of missing samples. Without this, a
    run would begin with a step from the command that the actuator is at.
    """
    state = inverse.state()

    def off(um: float) -> float:
        inverse.restore(state)
        return float(inverse.process(np.full(samples, um))[-1]) - command

    um, step_um = near_um, _FIRST_STEP_UM
    now = first = off(um)
    for _ in range(_MOST_STEPS):  # of the secant method
        um, before, now = um + step_um, now, off(um + step_um)
        if now == before or abs(step_um) < _SETTLED_UM:
            break
        step_um *= now / (before - now)
    if abs(now) < abs(first):
        return um
    inverse.restore(state)
    return near_um


def _and_still(commands: Iterable[F64], samples: int) -> Iterator[F64]:
    """Yield commands, then the last one for a number of samples."""
    last = 0.0
    for command in commands:
        if command.size:
            yield command
            last = float(command[-1])
    if samples:
        yield np.full(samples, last)


def _recorded_commands(path: Path, unit: str, sample_rate_hz: float) -> Iterator[F64]:
    """Yield the commands of a complete recorded run in order, then its safe value.

    The output is constant in skipped ticks.
    """
    from hilctl.recording.reader import RecordingStream  # slow to import, rarely needed

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
    from hilctl.recording.reader import read  # slow to import, rarely needed

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
