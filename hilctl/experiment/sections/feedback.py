"""The ``feedback`` section: settings, rules and design of the controller.

Behind the compensator the actuator is a gain of about 1 with a delay, so the delay, and with it
the sample rate, limits the bandwidth.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self, TypeAlias

from hilctl.base.errors import ConfigProblem, InputError, broken
from hilctl.base.strict import BeforeValidator, Field, StrictModel, model_validator
from hilctl.experiment.rig import Exchange, RunRig
from hilctl.experiment.sections.open_loop import (
    ASSUMED_PHASE_MARGIN_DEG,
    LEAST_GAIN_MARGIN_DB,
    LEAST_PHASE_MARGIN_DEG,
    LoopResponse,
    MeasuredResponse,
    assumed_response,
)
from hilctl.loop.feedback import (
    MOST_GAIN_PER_BLOCK,
    Controller,
    Feedback,
    Gains,
    IntegralFeedback,
)
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode

LOOP_DELAY = 2
"""Samples from a correction to the first tick that sees its effect: one until the sensor shows it,
and one until the displacement from that exchange is used."""

SLOW_SHARE = 0.2
"""Bandwidth of an integrator of block means, as a share of 1 / (2 pi delay): phase margin 79
degrees, gain margin nearly 8, enough for an actual gain several times that of the model, as on
small loops."""
UNKNOWN_RESONANCE_HZ = 5.0
"""Highest bandwidth of such an integrator without a known resonance: gain margin 2 for any above
500 Hz with a damping of 1 %."""


class _AnyFeedback(StrictModel):
    """Keys of every kind of feedback."""

    limit_um: float = Field(gt=0.0, description="largest correction of the compensator's input, um")
    sensor_delay_s: float = Field(
        default=0.0, ge=0.0, description="delay of the sensor and its line beyond the model's, s"
    )
    resonance_hz: float | None = Field(
        default=None,
        gt=0.0,
        description="lowest natural frequency of the actuator with its load, well above the"
        " bandwidth, Hz; default: that of the model's structure",
    )
    damping_ratio: float | None = Field(
        default=None, gt=0.0, le=2.0, description="damping ratio at resonance_hz"
    )
    response: str | None = Field(
        default=None,
        description="file of hilctl tune with the measured response, from which the margins are"
        " computed, instead of resonance_hz and damping_ratio",
    )


class PiFeedbackConfig(_AnyFeedback):
    """A PI controller around the compensator, for devices that exchange sample by sample.

    Attributes:
        bandwidth_hz: Frequency up to which the error is reduced; sets the gains.
        kp: Proportional gain, um of correction per um of error, instead of a bandwidth.
        ki_per_s: Integral gain per s, instead of a bandwidth.
    """

    kind: Literal["pi"] = "pi"
    bandwidth_hz: Annotated[float, Field(gt=0.0)] | None = None
    kp: Annotated[float, Field(ge=0.0)] | None = None
    ki_per_s: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        by_gains = self.kp is not None or self.ki_per_s is not None
        if by_gains == (self.bandwidth_hz is not None) or (by_gains and self.ki_per_s is None):
            raise ValueError("must have either bandwidth_hz or ki_per_s (with or without kp)")
        return self


class IntegralFeedbackConfig(_AnyFeedback):
    """An integrator of the mean error of each block, for every device (loop/feedback.py).

    Attributes:
        bandwidth_hz: Frequency below which offset, creep and drift are corrected; a step
            disturbance decays as e^(-2 pi bandwidth t).
    """

    kind: Literal["integral"]
    bandwidth_hz: Annotated[float, Field(gt=0.0)]


def _pi_where_not_said(value: Any) -> Any:
    return {"kind": "pi", **value} if isinstance(value, dict) else value


AnyFeedbackConfig: TypeAlias = PiFeedbackConfig | IntegralFeedbackConfig


FeedbackConfig: TypeAlias = Annotated[
    Annotated[AnyFeedbackConfig, Field(discriminator="kind")],
    BeforeValidator(_pi_where_not_said),
]


def make_feedback(
    wanted: AnyFeedbackConfig | None, exchange: Exchange, preview: int
) -> Controller | None:
    """Return the controller of a run whose compensator has a preview; None without feedback."""
    if wanted is None:
        return None
    rate_hz, block, latency_blocks = exchange
    due_after, shown_after = delays(wanted.sensor_delay_s, rate_hz, preview)
    gains = feedback_gains(wanted, rate_hz)
    if isinstance(wanted, IntegralFeedbackConfig):
        blocks = latency_blocks + LOOP_DELAY + math.ceil(shown_after / block)
        step = gains.ki_per_s * (block / rate_hz)
        return IntegralFeedback(step, wanted.limit_um, due_after, blocks)
    return Feedback(gains, rate_hz, wanted.limit_um, due_after, shown_after + LOOP_DELAY)


def delays(sensor_delay_s: float, rate_hz: float, preview: int) -> tuple[int, int]:
    """Return the samples from the reference, and from the input, to the displacement."""
    # preview: samples by which the input runs ahead of the commands.
    due_after = round(sensor_delay_s * rate_hz) + (0 if preview else 1)
    return due_after, due_after + preview


def feedback_problems(
    wanted: AnyFeedbackConfig | None,
    rig: RunRig,
    model: HysteresisModel | None,
    response: MeasuredResponse | None,
    preview: int,
) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``feedback`` section.

    ``model`` is the compensator's, and ``preview`` its samples of preview; ``response`` is the
    measured one, or None.
    """
    if wanted is None:
        return
    if model is None:
        yield broken("feedback", "needs a compensator, whose input it corrects")
    if response is not None:
        yield from _measured_problems(wanted, rig.exchange, model, response)
        most_hz = bandwidth_of(wanted.kind, MOST_GAIN_PER_BLOCK / rig.tick_s, rig.exchange.rate_hz)
        if isinstance(wanted, IntegralFeedbackConfig) and wanted.bandwidth_hz >= most_hz:
            rule = f"must be < {most_hz:.4g} Hz, for a gain per block below {MOST_GAIN_PER_BLOCK:g}"
            hint = "a smaller block allows more"
            yield broken("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", hint)
    resonance = _resonance(wanted, model)
    if isinstance(wanted, PiFeedbackConfig):
        allowed = True
        for problem in _exchange_problems(rig):
            allowed = False
            yield problem
        if allowed and model is not None and response is None:
            yield from _fast_problems(wanted, rig.exchange, resonance, preview)
    elif response is None:
        yield from _slow_problems(wanted, rig.exchange, resonance, preview)


def _exchange_problems(rig: RunRig) -> Iterator[ConfigProblem]:
    """Yield why a PI controller cannot act on each sample."""
    hint = "use feedback.kind integral for slow errors"
    if rig.exchange.latency_blocks:
        rule = f"needs a device that answers each sample immediately: {rig.info.name} has a FIFO"
        yield broken("feedback", rule, hint=hint)
    if rig.exchange.block > 1:
        yield broken("block", "must be 1 with PI feedback", str(rig.exchange.block), hint)


def _fast_problems(
    wanted: PiFeedbackConfig, exchange: Exchange, resonance: FirstMode | None, preview: int
) -> Iterator[ConfigProblem]:
    if resonance is None:
        rule = "needs resonance_hz and damping_ratio of the actuator with its load"
        hint = "feedback excites it; or measure it with 'hilctl tune', and set response"
        yield broken("feedback", rule, hint=hint)
        return
    delay_s = wanted.sensor_delay_s + max(0, preview - 1) / exchange.rate_hz
    assumed = assumed_response(exchange.rate_hz, delay_s, resonance)
    loop = assumed.controlled(feedback_gains(wanted, exchange.rate_hz), exchange)
    yield from _margin_problems(wanted, exchange.rate_hz, loop, ASSUMED_PHASE_MARGIN_DEG)


def _measured_problems(
    wanted: AnyFeedbackConfig,
    exchange: Exchange,
    model: HysteresisModel | None,
    response: MeasuredResponse,
) -> Iterator[ConfigProblem]:
    """Check the margins with the measured response."""
    try:
        response.check_model(model)
        loop = response.open_loop(feedback_gains(wanted, exchange.rate_hz), exchange)
    except InputError as error:
        hint = "measure again, and use 'hilctl tune' on the recording"
        yield broken("feedback.response", str(error), hint=hint)
        return
    yield from _margin_problems(wanted, exchange.rate_hz, loop, LEAST_PHASE_MARGIN_DEG)


def _margin_problems(
    wanted: AnyFeedbackConfig, rate_hz: float, loop: LoopResponse, phase_margin_deg: float
) -> Iterator[ConfigProblem]:
    """Yield that an open loop lacks its margins, with the gain that has them."""
    if loop.holds(phase_margin_deg):
        return
    gain_db, phase_deg = loop.margins
    rule = (
        f"must leave a gain margin of {LEAST_GAIN_MARGIN_DB:g} dB and a phase margin of "
        f"{phase_margin_deg:g} degrees"
    )
    value = f"{gain_db:.3g} dB and {phase_deg:.3g} degrees"
    room = loop.room(phase_margin_deg)
    key, hint = "feedback", f"multiply its gains by at most {rounded_down(room):g}"
    if wanted.bandwidth_hz is not None:
        key = "feedback.bandwidth_hz"
        ki_per_s = feedback_gains(wanted, rate_hz).ki_per_s
        highest_hz = bandwidth_of(wanted.kind, room * ki_per_s, rate_hz)
        hint = f"at most {rounded_down(highest_hz):g} Hz; a higher rate may allow more"
    yield broken(key, rule, value, hint)


def _slow_problems(
    wanted: IntegralFeedbackConfig, exchange: Exchange, resonance: FirstMode | None, preview: int
) -> Iterator[ConfigProblem]:
    """Compare the bandwidth of an integrator with the loop's delay and the resonance."""
    shown_s = wanted.sensor_delay_s + max(1, preview) / exchange.rate_hz
    waits = (exchange.latency_blocks + 1) * exchange.block
    delay_s = waits / exchange.rate_hz + shown_s
    highest_hz = SLOW_SHARE / (2.0 * math.pi * delay_s)
    rule = f"must be <= {highest_hz:.4g} Hz by the delay of the loop, {delay_s:.3g} s"
    hint = "a smaller block or a higher rate shortens the delay"
    if resonance is not None:
        if resonance.damping_ratio * resonance.natural_hz < highest_hz:
            highest_hz = resonance.damping_ratio * resonance.natural_hz
            rule = f"must be <= {highest_hz:.4g} Hz, damping times natural frequency"
            hint = f"the gain at {resonance.natural_hz:g} Hz must be at most 0.5"
    elif highest_hz > UNKNOWN_RESONANCE_HZ:
        highest_hz = UNKNOWN_RESONANCE_HZ
        rule = f"must be <= {highest_hz:g} Hz without a known resonance"
        hint = "set resonance_hz and damping_ratio of the actuator with its load, or response"
    if wanted.bandwidth_hz > highest_hz:
        yield broken("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", hint)


def feedback_gains(wanted: AnyFeedbackConfig, rate_hz: float) -> Gains:
    """Return the gains of a controller."""
    if isinstance(wanted, IntegralFeedbackConfig):
        return Gains(0.0, 2.0 * math.pi * wanted.bandwidth_hz)
    if wanted.bandwidth_hz is None:
        return Gains(wanted.kp or 0.0, wanted.ki_per_s or 0.0)
    return gains_for(min(wanted.bandwidth_hz, 0.5 * rate_hz), rate_hz)


def _resonance(wanted: AnyFeedbackConfig, model: HysteresisModel | None) -> FirstMode | None:
    """Return the resonance of the experiment or the model; None if it is unknown."""
    structure = getattr(model, "structure", None)
    natural_hz = wanted.resonance_hz or getattr(structure, "natural_hz", None)
    damping = wanted.damping_ratio or getattr(structure, "damping_ratio", None)
    if natural_hz is None or damping is None:
        return None
    return FirstMode(natural_hz=natural_hz, damping_ratio=damping)


def gains_for(bandwidth_hz: float, rate_hz: float) -> Gains:
    """Return the gains whose open loop crosses 1 at ``bandwidth_hz``, below half the rate."""
    # On a gain of 1 with a delay the integral alone crosses 1 at ki / (2 pi).
    return Gains(0.0, 2.0 * rate_hz * math.sin(math.pi * bandwidth_hz / rate_hz))


def bandwidth_of(kind: str, ki_per_s: float, rate_hz: float) -> float:
    """Return the bandwidth of an integral gain, see :func:`feedback_gains`."""
    if kind == "integral":
        return ki_per_s / (2.0 * math.pi)
    return rate_hz / math.pi * math.asin(min(0.5 * ki_per_s / rate_hz, 1.0))


def rounded_down(value: float, digits: int = 3) -> float:
    """Return a value rounded towards zero, because a limit must not grow."""
    if value == 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)
    return float(f"{math.trunc(value / step + math.copysign(1e-9, value)) * step:.12g}")
