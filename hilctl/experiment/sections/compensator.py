"""The ``compensator`` section: settings, initial state, and the rules on its start.

A compensator starts at rest, or with the memory that earlier commands left.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.segments import Segment
from hilctl.base.strict import StrictModel
from hilctl.base.types import F64
from hilctl.experiment.rig import RunRig
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel, Operator
from hilctl.waveforms.spec import AnyWaveform

_STILL_S = 1.0
_AT_REST_S = 0.1  # after which the stages of any actuator are at rest
_FEWEST_SAMPLES = 16  # which a delay and a preview need at a low rate
_FIRST_STEP_UM = 1e-4
_SETTLED_UM = 1e-9
_MOST_STEPS = 20
_SOFT_SHARE = 0.25  # of the slew limit, for a soft start


class CompensatorConfig(StrictModel):
    """The model whose inverse drives the actuator.

    Attributes:
        model: Model file, relative to the experiment file's folder.
        correction: Correction file of ``hilctl learn`` for this waveform, relative to the same
            folder. Default: none.
        initial_state: Initial state without a condition: ``last`` for the state after the last run
            of this device, ``rest``, or the recording of an earlier run, relative to the same
            folder. A lead-in of ``safe.ramp_s`` connects it to the reference.
        offset: ``identified`` uses the model's offset; ``measured`` corrects it by the difference
            between sensor and model at rest before the waveform, for a sensor or an actuator that
            has moved since.
    """

    model: str
    correction: str | None = None
    initial_state: str = "last"
    offset: Literal["identified", "measured"] = "identified"


def none_or_mapping(value: Any) -> Any:
    """Return the value of the section, a mapping or None for ``none``."""
    if value == "none":
        return None
    if not isinstance(value, dict):
        rule = "must be none, or a mapping with the key model"
        raise ValueError(f"{rule}: {value!r}")  # noqa: TRY004  pydantic wants this one
    return value


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


def model_problems(model: HysteresisModel | None, info: DeviceInfo) -> Iterator[ConfigProblem]:
    """Yield that the model is for a device of the other unit."""
    if model is not None and model.input_unit != info.command_unit:
        rule = f"must give commands in {info.command_unit}, the unit of {info.name}"
        yield broken("compensator.model", rule, model.input_unit)


def finite_problems(low: float, high: float, unit: str) -> Iterator[ConfigProblem]:
    """Yield that a run from ``low`` to ``high`` has commands that are no finite numbers."""
    if not (math.isfinite(low) and math.isfinite(high)):
        rule = "every command must be a finite number"
        yield broken("compensator.model", rule, f"{low:.6g} to {high:.6g} {unit}")


def identified_um(model: HysteresisModel | None, rests_um: float) -> tuple[float, float] | None:
    """Return the displacements that a model was identified on; None if they are unknown.

    A run begins at ``rests_um``, which a drive of one sign leaves for good with its first rise, so
    they include it.
    """
    if model is None or model.output_range_um is None:
        return None
    ends_um = *model.output_range_um, rests_um
    return min(ends_um), max(ends_um)


def start_problems(
    start: CompensatorStart,
    rig: RunRig,
    waveform: AnyWaveform,
    rests_um: float,
    first_command: float,
    slew_per_s: float,
) -> Iterator[ConfigProblem]:
    """Yield that the first command of a model would be a step from the safe value.

    The actuator rests at ``rests_um`` there. ``slew_per_s`` is the fastest change of the run.
    """
    # A higher slew limit would be the wrong remedy: it would pass the step on to the coil.
    limit_per_s, safe = rig.command.slew_per_s, rig.command.safe
    step = abs(first_command - safe)
    step_per_s = step * rig.exchange.rate_hz
    if not limit_per_s < slew_per_s < math.inf:
        return
    if not limit_per_s < step_per_s or not slew_per_s <= step_per_s * (1.0 + 1e-9):
        return
    key, part = "waveform", waveform
    if part.kind == "sequence":
        key, part = "waveform.parts.0", part.parts[0]
    soft_s = max(rig.ramp_s, 0.5 * math.pi * step / (_SOFT_SHARE * limit_per_s))
    cure = f"set {key}.soft_start_s to {soft_s:.3g}"
    if part.soft_start_s:
        cure = f"remove {key}.rest: {rests_um:.4g} is its default"
    rests = f"the actuator rests at {safe:g} {rig.unit}, {rests_um:.4g} µm by the model"
    hint = f"its first command would step to {first_command:.4g} {rig.unit}: {cure}"
    value = f"{float(start.input_um[:1][0]):.4g} µm"
    yield broken("waveform", f"must begin where {rests}", value, hint)


def lead_in_problems(
    start: CompensatorStart, rig: RunRig, reference_um: F64
) -> Iterator[ConfigProblem]:
    """Yield that the lead-in from the initial displacement trips on the tracking error."""
    error_um = rig.interlocks.tracking_error_um
    if error_um is None:
        return
    led_um = reference_um[start.preview :][: rig.lead_in_samples]
    apart_um = np.abs(led_um - start.input_um[: led_um.size])
    samples = (rig.interlocks.tracking_s or 0.0) * rig.exchange.rate_hz
    if not np.count_nonzero(apart_um > error_um) > samples:
        return
    rule = f"the actuator must be at most {error_um:g} µm from the reference at the start"
    hint = "the tracking error would end the run: set waveform.soft_start_s, or begin the reference"
    yield broken("waveform", rule, f"{apart_um[0]:.4g} µm", f"{hint} near its rest")
