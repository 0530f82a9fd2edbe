"""The ``feedback`` and ``adaptation`` sections: design, rules, and the commands at their bounds.

Behind the compensator the actuator is a gain of about 1 with a delay, so the delay, and with it
the sample rate, limits the bandwidth.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from hilctl.base.errors import ConfigProblem, InputError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.experiment.file import (
    AnyFeedbackConfig,
    Experiment,
    IntegralFeedbackConfig,
    PiFeedbackConfig,
)
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.open_loop import (
    ASSUMED_PHASE_MARGIN_DEG,
    LEAST_GAIN_MARGIN_DB,
    LEAST_PHASE_MARGIN_DEG,
    Exchange,
    LoopResponse,
    assumed_response,
)
from hilctl.loop.adaptation import Adaptation, AdaptationBounds, DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.loop.feedback import (
    MOST_GAIN_PER_BLOCK,
    Controller,
    Feedback,
    Gains,
    IntegralFeedback,
)
from hilctl.models.linear_stages import FirstMode
from hilctl.waveforms.build import Reference

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


def make_feedback(
    config: Experiment, compensator: Compensator, latency_blocks: int = 0
) -> Controller | None:
    """Return the controller of a run, or None; answers take ``latency_blocks`` exchanges."""
    wanted = config.feedback
    if wanted is None:
        return None
    rate_hz = config.sample_rate_hz
    due_after, shown_after = delays(wanted.sensor_delay_s, rate_hz, compensator.preview)
    gains = feedback_gains(wanted, rate_hz)
    if isinstance(wanted, IntegralFeedbackConfig):
        blocks = latency_blocks + LOOP_DELAY + math.ceil(shown_after / config.block)
        return IntegralFeedback(gains.ki_per_s * config.tick_s, wanted.limit_um, due_after, blocks)
    return Feedback(gains, rate_hz, wanted.limit_um, due_after, shown_after + LOOP_DELAY)


def delays(sensor_delay_s: float, rate_hz: float, preview: int) -> tuple[int, int]:
    """Return the samples from the reference, and from the input, to the displacement."""
    # preview: samples by which the input runs ahead of the commands.
    due_after = round(sensor_delay_s * rate_hz) + (0 if preview else 1)
    return due_after, due_after + preview


def feedback_problems(loaded: LoadedExperiment, preview: int) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``feedback`` section."""
    config, wanted = loaded.config, loaded.config.feedback
    if wanted is None:
        return
    if config.compensator is None:
        yield loaded.problem("feedback", "needs a compensator, whose input it corrects")
    if loaded.response is not None:
        yield from _measured_problems(loaded, wanted)
        most_hz = bandwidth_of(
            wanted.kind, MOST_GAIN_PER_BLOCK / config.tick_s, config.sample_rate_hz
        )
        if isinstance(wanted, IntegralFeedbackConfig) and wanted.bandwidth_hz >= most_hz:
            rule = f"must be < {most_hz:.4g} Hz, for a gain per block below {MOST_GAIN_PER_BLOCK:g}"
            hint = "a smaller block allows more"
            yield loaded.problem("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", hint)
    if isinstance(wanted, PiFeedbackConfig):
        yield from _fast_problems(loaded, wanted, preview)
    elif loaded.response is None:
        yield from _slow_problems(loaded, wanted, preview)


def _fast_problems(
    loaded: LoadedExperiment, wanted: PiFeedbackConfig, preview: int
) -> Iterator[ConfigProblem]:
    config, info = loaded.config, loaded.device.info
    hint = "use feedback.kind integral for slow errors"
    if info.latency_blocks:
        rule = f"needs a device that answers each sample immediately: {info.name} has a FIFO"
        yield loaded.problem("feedback", rule, hint=hint)
    if config.block > 1:
        yield loaded.problem("block", "must be 1 with PI feedback", str(config.block), hint)
    if info.latency_blocks or config.block > 1 or config.compensator is None or wanted.response:
        return
    resonance = _resonance(loaded, wanted)
    if resonance is None:
        rule = "needs resonance_hz and damping_ratio of the actuator with its load"
        hint = "feedback excites it; or measure it with 'hilctl tune', and set response"
        yield loaded.problem("feedback", rule, hint=hint)
        return
    delay_s = wanted.sensor_delay_s + max(0, preview - 1) / config.sample_rate_hz
    assumed = assumed_response(config.sample_rate_hz, delay_s, resonance)
    loop = assumed.controlled(feedback_gains(wanted, config.sample_rate_hz), exchange_of(loaded))
    yield from _margin_problems(loaded, wanted, loop, ASSUMED_PHASE_MARGIN_DEG)


def _measured_problems(
    loaded: LoadedExperiment, wanted: AnyFeedbackConfig
) -> Iterator[ConfigProblem]:
    """Check the margins with the measured response."""
    assert loaded.response is not None
    gains = feedback_gains(wanted, loaded.config.sample_rate_hz)
    try:
        loaded.response.check_model(loaded.model)
        loop = loaded.response.open_loop(gains, exchange_of(loaded))
    except InputError as error:
        hint = "measure again, and use 'hilctl tune' on the recording"
        yield loaded.problem("feedback.response", str(error), hint=hint)
        return
    yield from _margin_problems(loaded, wanted, loop, LEAST_PHASE_MARGIN_DEG)


def _margin_problems(
    loaded: LoadedExperiment, wanted: AnyFeedbackConfig, loop: LoopResponse, phase_margin_deg: float
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
    room, rate_hz = loop.room(phase_margin_deg), loaded.config.sample_rate_hz
    gains = feedback_gains(wanted, rate_hz)
    key, hint = "feedback", f"multiply its gains by at most {rounded_down(room):g}"
    if wanted.bandwidth_hz is not None:
        key = "feedback.bandwidth_hz"
        highest_hz = bandwidth_of(wanted.kind, room * gains.ki_per_s, rate_hz)
        hint = f"at most {rounded_down(highest_hz):g} Hz; a higher rate may allow more"
    yield loaded.problem(key, rule, value, hint)


def _slow_problems(
    loaded: LoadedExperiment, wanted: IntegralFeedbackConfig, preview: int
) -> Iterator[ConfigProblem]:
    """Compare the bandwidth of an integrator with the loop's delay and the resonance."""
    config, info = loaded.config, loaded.device.info
    shown_s = wanted.sensor_delay_s + max(1, preview) / config.sample_rate_hz
    delay_s = (info.latency_blocks + 1) * config.tick_s + shown_s
    highest_hz = SLOW_SHARE / (2.0 * math.pi * delay_s)
    rule = f"must be <= {highest_hz:.4g} Hz by the delay of the loop, {delay_s:.3g} s"
    resonance = _resonance(loaded, wanted)
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
        yield loaded.problem("feedback.bandwidth_hz", rule, f"{wanted.bandwidth_hz:g}", hint)


def feedback_gains(wanted: AnyFeedbackConfig, rate_hz: float) -> Gains:
    """Return the gains of a controller."""
    if isinstance(wanted, IntegralFeedbackConfig):
        return Gains(0.0, 2.0 * math.pi * wanted.bandwidth_hz)
    if wanted.bandwidth_hz is None:
        return Gains(wanted.kp or 0.0, wanted.ki_per_s or 0.0)
    return gains_for(min(wanted.bandwidth_hz, 0.5 * rate_hz), rate_hz)


def exchange_of(loaded: LoadedExperiment) -> Exchange:
    """Return the timing of the loop."""
    config = loaded.config
    return Exchange(config.sample_rate_hz, config.block, loaded.device.info.latency_blocks)


def _resonance(loaded: LoadedExperiment, wanted: AnyFeedbackConfig) -> FirstMode | None:
    """Return the resonance of the experiment or the model; None if it is unknown."""
    structure = getattr(loaded.model, "structure", None)
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


OFFSET_SHARE = 0.1
"""Default largest offset, of the stroke limits."""
_SLOWER = 5.0
"""Least time constant in loop delays per parameter (all may adapt to the same samples), which keeps
the phase margin above 60 degrees."""


def adaptation_bounds(config: Experiment) -> AdaptationBounds:
    """Return the bounds of the adapted parameters; all 0 without adaptation."""
    # Feedback removes the offset; a correction contains gain and weights of one model.
    wanted, compensator = config.adaptation, config.compensator
    if wanted is None or compensator is None:
        return AdaptationBounds(0.0, 0.0, 0.0)
    low_um, high_um = config.limits.stroke_um
    offset_um = wanted.offset_um
    if config.feedback is not None:
        offset_um = 0.0
    elif offset_um is None:
        offset_um = OFFSET_SHARE * (high_um - low_um)
    shape = 0.0 if compensator.correction else 1.0
    return AdaptationBounds(offset_um, shape * wanted.gain, shape * wanted.weight)


def adapted_operator(config: Experiment, reference: Reference) -> DisplacementOperator | None:
    """Return the adapted operator for a reference; None without adaptation."""
    bounds = adaptation_bounds(config)
    if not bounds.array.any():
        return None
    return DisplacementOperator.over(reference.values, bounds, reference.telling)


def make_adaptation(
    config: Experiment, operator: DisplacementOperator | None, compensator: Compensator
) -> Adaptation | None:
    """Return the adaptation of a run, or None."""
    wanted = config.adaptation
    if wanted is None or operator is None:
        return None
    return Adaptation(
        operator,
        wanted.time_constant_s,
        config.sample_rate_hz,
        *delays(wanted.sensor_delay_s, config.sample_rate_hz, compensator.preview),
        wanted.noise_um,
    )


def adaptation_problems(loaded: LoadedExperiment, preview: int) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``adaptation`` section."""
    config, wanted = loaded.config, loaded.config.adaptation
    if wanted is None:
        return
    if config.compensator is None:
        yield loaded.problem("adaptation", "needs a compensator, whose model it adapts")
    if config.feedback is not None and wanted.offset_um:
        hint = "remove it: feedback corrects the same offset"
        rule, value = "must be 0 with feedback", f"{wanted.offset_um:g}"
        yield loaded.problem("adaptation.offset_um", rule, value, hint)
    rests = config.condition is not None or (
        config.compensator is not None and config.compensator.offset == "measured"
    )
    if wanted.noise_um is None and not rests:
        rule = "is required without a rest before the waveform to measure it in"
        hint = "set it, or a condition, or compensator.offset: measured"
        yield loaded.problem("adaptation.noise_um", rule, hint=hint)
    shortest_s = _shortest_s(loaded, preview)
    if wanted.time_constant_s < shortest_s:
        rule = f"must be >= {shortest_s:.3g} s, by the delay of the loop"
        hint = "a smaller block or a higher rate shortens the delay"
        value = f"{wanted.time_constant_s:g}"
        yield loaded.problem("adaptation.time_constant_s", rule, value, hint)


def adaptation_warnings(config: Experiment, segments: tuple[Segment, ...]) -> tuple[str, ...]:
    """Return reasons why the adaptation may have no effect or an unwanted one."""
    wanted = config.adaptation
    if wanted is None:
        return ()
    if not adaptation_bounds(config).array.any():
        return ("adaptation has no effect: feedback, a correction or bounds of 0 exclude it",)
    longest_s = max((each.period for each in segments), default=0.0) / config.sample_rate_hz
    if longest_s <= wanted.time_constant_s:
        return ()
    periods = (
        f"{wanted.time_constant_s:g} s is less than a period of the waveform, {longest_s:.3g} s"
    )
    return (f"adaptation.time_constant_s: {periods}: parameters will follow each period",)


def _shortest_s(loaded: LoadedExperiment, preview: int) -> float:
    config, wanted = loaded.config, loaded.config.adaptation
    assert wanted is not None
    _, shown_after = delays(wanted.sensor_delay_s, config.sample_rate_hz, preview)
    ticks = loaded.device.info.latency_blocks + LOOP_DELAY
    delay_s = ticks * config.tick_s + shown_after / config.sample_rate_hz
    return _SLOWER * np.count_nonzero(adaptation_bounds(config).array) * delay_s


def worst_inputs(
    config: Experiment, operator: DisplacementOperator | None, input_um: F64
) -> Iterator[Callable[[int, int], F64]]:
    """Yield the compensator's input with the adaptation at its bounds, where it is largest.

    Each input, float64[n] in all, returns its parts from a start to a stop, called in order.
    """
    if operator is None:
        return
    # Parameters move no faster than the lead-in.
    led = min(config.lead_in_samples, input_um.size)
    for sign in (1.0, -1.0) if operator.bounds[0] else (1.0,):
        signs = np.array([sign, *[1.0] * (operator.bounds.size - 1)])
        yield _worst_input(operator, input_um, operator.form(-operator.bounds * signs), led)


def _worst_input(
    operator: DisplacementOperator, input_um: F64, worst: F64, led: int
) -> Callable[[int, int], F64]:
    """Return the input with parameters that move over ``led`` samples from 0 to ``worst``."""
    memory = operator.at_rest(float(input_um[0:1][0]))

    def part(start: int, stop: int) -> F64:
        out = np.array(input_um[start:stop])
        on_the_way = max(min(stop, led) - start, 0)
        if on_the_way:
            begins, ends = (at / led * worst for at in (start, start + on_the_way))
            operator.invert(out[:on_the_way], on_the_way, begins, ends, memory)
        there = out[on_the_way:]
        operator.invert(there, there.size, worst, worst, memory)
        return out

    return part


def at_worst(problem: ConfigProblem) -> ConfigProblem:
    """Return a problem marked as caused by the bounds of the adaptation."""
    hint = f"{problem.hint}; or reduce the bounds of adaptation"
    return replace(problem, rule=f"with adaptation at its bounds, {problem.rule}", hint=hint)
