"""Adaptation from an experiment: its bounds, what it can't be without, and the worst it may do."""

from collections.abc import Iterator
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

_OFFSET_SHARE = 0.1  # of the stroke's limits, where no bound is given
_SLOWER = 5.0
"""Time constant over the loop's delay times the number of parameters, which may all be moved by the
same samples: with it the phase margin is above 60 degrees."""


def adaptation_bounds(config: Experiment) -> AdaptationBounds:
    """Return how far a run may adapt its model; all 0 where it does not.

    Feedback takes the offset out by itself; and while a correction of learning is used, gain and
    weights rest: it has what they would change, and only for the model as it was.
    """
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
    """Return what a run adapts, for its reference; None where nothing is adapted."""
    bounds = adaptation_bounds(config)
    if not bounds.array.any():
        return None
    return DisplacementOperator.over(reference.values, bounds, reference.telling)


def make_adaptation(
    config: Experiment, operator: DisplacementOperator | None, compensator: Compensator
) -> Adaptation | None:
    """Return the adaptation of a run, or None where nothing is adapted.

    Args:
        config: The experiment.
        operator: What it adapts, see :func:`adapted_operator`.
        compensator: What stands behind it.
    """
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


def adaptation_problems(loaded: LoadedExperiment, preview: int) -> list[ConfigProblem]:
    """Return why an experiment can't have the adaptation that it asks for.

    Args:
        loaded: The experiment.
        preview: Samples by which its compensator looks ahead.
    """
    config, wanted = loaded.config, loaded.config.adaptation
    if wanted is None:
        return []
    found: list[tuple[str, str, str, str]] = []
    if config.compensator is None:
        found.append(("adaptation", "needs a compensator: it adapts the model of one", "", ""))
    if config.feedback is not None and wanted.offset_um:
        hint = "leave it out: both would take out the same offset"
        rule = "must be 0 with feedback"
        found.append(("adaptation.offset_um", rule, f"{wanted.offset_um:g}", hint))
    rests = config.condition is not None or (
        config.compensator is not None and config.compensator.offset == "measured"
    )
    if wanted.noise_um is None and not rests:
        rule = "is needed where there is no rest before the waveform that shows it"
        hint = "give it, or a condition, or compensator.offset: measured"
        found.append(("adaptation.noise_um", rule, "", hint))
    shortest_s = _shortest_s(loaded, preview)
    if wanted.time_constant_s < shortest_s:
        rule = f"must be >= {shortest_s:.3g} s, by the delay of the loop"
        hint = "a smaller block or a higher rate makes the delay shorter"
        found.append(("adaptation.time_constant_s", rule, f"{wanted.time_constant_s:g}", hint))
    return [
        ConfigProblem(loaded.document.where(tuple(key.split("."))), key, rule, value, hint)
        for key, rule, value, hint in found
    ]


def adaptation_warnings(config: Experiment, segments: tuple[Segment, ...]) -> tuple[str, ...]:
    """Return what keeps the adaptation of a run from doing what it may be there for.

    Args:
        config: The experiment.
        segments: Those of its reference.
    """
    wanted = config.adaptation
    if wanted is None:
        return ()
    if not adaptation_bounds(config).array.any():
        return ("nothing is adapted: feedback has the offset, and a correction or bounds the rest",)
    longest_s = max((each.period for each in segments), default=0.0) / config.sample_rate_hz
    if longest_s <= wanted.time_constant_s:
        return ()
    periods = (
        f"{wanted.time_constant_s:g} s is less than a period of the waveform, {longest_s:.3g} s"
    )
    return (f"adaptation.time_constant_s: {periods}: parameters will follow each of them",)


def _shortest_s(loaded: LoadedExperiment, preview: int) -> float:
    config, wanted = loaded.config, loaded.config.adaptation
    assert wanted is not None
    _, shown_after = delays(wanted.sensor_delay_s, config.sample_rate_hz, preview)
    ticks = loaded.device.info.latency_blocks + LOOP_DELAY
    delay_s = ticks * config.tick_s + shown_after / config.sample_rate_hz
    return _SLOWER * np.count_nonzero(adaptation_bounds(config).array) * delay_s


def worst_inputs(
    config: Experiment, operator: DisplacementOperator | None, input_um: F64
) -> Iterator["WorstInput"]:
    """Give the compensator's input with the adaptation at its bounds, where they make it largest.

    Args:
        config: The experiment.
        operator: What it adapts; None where nothing is adapted.
        input_um: float64[n], the input without adaptation.
    """
    if operator is None:
        return
    # As far as they go in a run: over its lead-in, and no faster.
    led = min(config.lead_in_samples, input_um.size)
    for sign in (1.0, -1.0) if operator.bounds[0] else (1.0,):
        worst = operator.form(
            -operator.bounds * np.array([sign, *[1.0] * (operator.bounds.size - 1)])
        )
        yield WorstInput(operator, input_um, worst, led)


class WorstInput:
    """The compensator's input with adapted parameters, one part after the other.

    Args:
        operator: What is adapted.
        input_um: float64[n], the input without adaptation.
        worst: float64[m], o, g and w_i that they come to.
        led: Samples on the way there, at most n.
    """

    def __init__(self, operator: DisplacementOperator, input_um: F64, worst: F64, led: int) -> None:
        self._operator, self._input_um, self._worst, self._led = operator, input_um, worst, led
        self._memory = operator.at_rest(float(input_um[0:1][0]))

    def __call__(self, start: int, stop: int) -> F64:
        """Return its next part, float64[stop - start]."""
        out, worst = np.array(self._input_um[start:stop]), self._worst
        on_the_way = max(min(stop, self._led) - start, 0)
        if on_the_way:
            begins, ends = (at / self._led * worst for at in (start, start + on_the_way))
            part = out[:on_the_way]
            self._operator.invert(part, on_the_way, begins, ends, self._memory)
        there = out[on_the_way:]
        self._operator.invert(there, there.size, worst, worst, self._memory)
        return out


def at_worst(problem: ConfigProblem) -> ConfigProblem:
    """Return a problem that only the bounds of the adaptation make."""
    hint = f"{problem.hint}; or smaller bounds of adaptation"
    return replace(problem, rule=f"with adaptation at its bounds, {problem.rule}", hint=hint)
