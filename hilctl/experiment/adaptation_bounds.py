"""The ``adaptation`` section: its bounds, its rules, and the commands at its bounds."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from hilctl.base.errors import ConfigProblem
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.experiment.feedback_checks import LOOP_DELAY, delays
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.adaptation import Adaptation, AdaptationBounds, DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.waveforms.build import Reference

_OFFSET_SHARE = 0.1  # of the stroke limits, by default
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
        offset_um = _OFFSET_SHARE * (high_um - low_um)
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
