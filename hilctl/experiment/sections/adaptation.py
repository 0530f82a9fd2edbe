"""The ``adaptation`` section: settings, rules, and the commands at its bounds."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated

import numpy as np

from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.segments import Segment
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64
from hilctl.experiment.rig import RunRig
from hilctl.experiment.sections.feedback import LOOP_DELAY, delays
from hilctl.loop.adaptation import Adaptation, AdaptationBounds, DisplacementOperator
from hilctl.waveforms.build import Reference

OFFSET_SHARE = 0.1
"""Default largest offset, of the stroke limits."""
_SLOWER = 5.0
"""Least time constant in loop delays per parameter (all may adapt to the same samples), which keeps
the phase margin above 60 degrees."""


class AdaptationConfig(StrictModel):
    """Slow adaptation of the compensator's model by the tracking error (loop/adaptation.py).

    Attributes:
        time_constant_s: Time in which the model error decays to 1/e.
        offset_um: Largest adapted offset. Default: a tenth of ``limits.stroke_um``, or 0 with
            feedback, which corrects the offset itself.
        gain: Largest change of the gain, relative to the identified one.
        weight: Largest weight of each play after the model, relative to the identified gain.
        noise_um: Standard deviation of the sensor's noise, for the dead zone. Default: that of the
            rest before the waveform (``condition`` or ``compensator.offset: measured``).
        sensor_delay_s: Delay of the sensor and its line beyond the model's.
    """

    time_constant_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    offset_um: Annotated[float, Field(ge=0.0)] | None = None
    gain: Annotated[float, Field(ge=0.0, le=0.3)] = 0.1
    weight: Annotated[float, Field(ge=0.0, le=0.1)] = 0.02
    noise_um: Annotated[float, Field(ge=0.0)] | None = None
    sensor_delay_s: Annotated[float, Field(ge=0.0)] = 0.0

    def bounds(
        self, stroke_um: tuple[float, float], *, feedback: bool, corrected: bool
    ) -> AdaptationBounds:
        """Return the bounds of the adapted parameters.

        Feedback removes the offset; a correction contains gain and weights of one model.
        """
        offset_um = self.offset_um
        if feedback:
            offset_um = 0.0
        elif offset_um is None:
            offset_um = OFFSET_SHARE * (stroke_um[1] - stroke_um[0])
        shape = 0.0 if corrected else 1.0
        return AdaptationBounds(offset_um, shape * self.gain, shape * self.weight)


def adapted_operator(
    bounds: AdaptationBounds | None, reference: Reference
) -> DisplacementOperator | None:
    """Return the adapted operator for a reference; None without adaptation."""
    if bounds is None or not bounds.array.any():
        return None
    return DisplacementOperator.over(reference.values, bounds, reference.telling)


def make_adaptation(
    wanted: AdaptationConfig | None,
    operator: DisplacementOperator | None,
    rate_hz: float,
    preview: int,
) -> Adaptation | None:
    """Return the adaptation of a run whose compensator has a preview; None without."""
    if wanted is None or operator is None:
        return None
    after = delays(wanted.sensor_delay_s, rate_hz, preview)
    return Adaptation(operator, wanted.time_constant_s, rate_hz, *after, wanted.noise_um)


def adaptation_problems(
    wanted: AdaptationConfig | None,
    bounds: AdaptationBounds | None,
    rig: RunRig,
    preview: int,
    *,
    feedback: bool,
    rests: bool,
) -> Iterator[ConfigProblem]:
    """Yield the broken rules of the ``adaptation`` section.

    ``bounds`` are None without a compensator, ``preview`` is its samples of preview. ``rests``
    tells whether the run rests before its waveform, where the noise can be measured.
    """
    if wanted is None:
        return
    if bounds is None:
        yield broken("adaptation", "needs a compensator, whose model it adapts")
    if feedback and wanted.offset_um:
        hint = "remove it: feedback corrects the same offset"
        rule, value = "must be 0 with feedback", f"{wanted.offset_um:g}"
        yield broken("adaptation.offset_um", rule, value, hint)
    if wanted.noise_um is None and not rests:
        rule = "is required without a rest before the waveform to measure it in"
        hint = "set it, or a condition, or compensator.offset: measured"
        yield broken("adaptation.noise_um", rule, hint=hint)
    adapted = 0 if bounds is None else np.count_nonzero(bounds.array)
    shortest_s = _SLOWER * adapted * _delay_s(wanted, rig, preview)
    if wanted.time_constant_s < shortest_s:
        rule = f"must be >= {shortest_s:.3g} s, by the delay of the loop"
        hint = "a smaller block or a higher rate shortens the delay"
        value = f"{wanted.time_constant_s:g}"
        yield broken("adaptation.time_constant_s", rule, value, hint)


def _delay_s(wanted: AdaptationConfig, rig: RunRig, preview: int) -> float:
    rate_hz = rig.exchange.rate_hz
    _, shown_after = delays(wanted.sensor_delay_s, rate_hz, preview)
    ticks = rig.exchange.latency_blocks + LOOP_DELAY
    return ticks * rig.tick_s + shown_after / rate_hz


def adaptation_warnings(
    wanted: AdaptationConfig | None,
    bounds: AdaptationBounds | None,
    segments: tuple[Segment, ...],
    rate_hz: float,
) -> tuple[str, ...]:
    """Return reasons why the adaptation may have no effect or an unwanted one."""
    if wanted is None or bounds is None:
        return ()
    if not bounds.array.any():
        return ("adaptation has no effect: feedback, a correction or bounds of 0 exclude it",)
    longest_s = max((each.period for each in segments), default=0.0) / rate_hz
    if longest_s <= wanted.time_constant_s:
        return ()
    periods = (
        f"{wanted.time_constant_s:g} s is less than a period of the waveform, {longest_s:.3g} s"
    )
    return (f"adaptation.time_constant_s: {periods}: parameters will follow each period",)


def worst_inputs(
    operator: DisplacementOperator | None, input_um: F64, lead_in_samples: int
) -> Iterator[Callable[[int, int], F64]]:
    """Yield the compensator's input with the adaptation at its bounds, where it is largest.

    Each input, float64[n] in all, returns its parts from a start to a stop, called in order.
    """
    if operator is None:
        return
    # Parameters move no faster than the lead-in.
    led = min(lead_in_samples, input_um.size)
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
