"""The cure for an exceeded limit: what in the experiment to change, where and by how much."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Context

from hilctl.base.errors import ConfigProblem
from hilctl.experiment.coil_heat import CoolingCoil
from hilctl.experiment.forecast import Forecast
from hilctl.experiment.rig import RunRig
from hilctl.experiment.sections.limits import Excess, Limits
from hilctl.waveforms.build import Reference
from hilctl.waveforms.spec import AnyWaveform

_SLOWER = "lower frequency or amplitude, soften jumps (soft_start_s, soft_end_s, rise_s)"
_SOFT_START, _SOFT_END = "the soft start", "the soft end"
_MORE_SLOPE = 1.5  # of a loop at its ends, than on average


@dataclass(frozen=True, slots=True)
class Course:
    """A waveform and the commands that it needs, on a rig."""

    waveform: AnyWaveform
    reference: Reference
    forecast: Forecast
    limits: Limits
    rig: RunRig


def cured(found: Iterable[Excess], course: Course) -> Iterator[ConfigProblem]:
    """Yield the problem of each exceeded limit with its cure."""
    for each in found:
        yield replace(each.problem, hint=cure(each, course))


def cure(excess: Excess, course: Course) -> str:
    """Return how far a limit is exceeded, when, and what to change."""
    if excess.of == "heat" and (wait := _wait(course)):
        return wait
    change, raised = _CHANGES[excess.of](excess, course)
    place = ""
    if not math.isnan(excess.at_s):
        place, soft_end = _place(course, excess.at_s)
        change = soft_end or change
    otherwise = f", or {raised}" if raised else ""
    return f"{excess.amount:.3g} {excess.unit} too much{place}: {change}{otherwise}"


def _of_reference(excess: Excess, course: Course) -> tuple[str, str]:
    return _fitting(course.waveform, course.reference.span, excess.allowed), ""


def _of_command(excess: Excess, course: Course) -> tuple[str, str]:
    forecast, limits, info = course.forecast, course.limits, course.rig.info
    span = forecast.command_min, forecast.command_max
    fitting = _fitting(course.waveform, span, excess.allowed)
    change = _smaller(course, excess.amount) or fitting
    if getattr(course.waveform, "offset", 0.0) and _at(course, excess.at_s)[1] == _SOFT_START:
        # Its loops are smaller than those by which an amplitude is estimated.
        kind = course.waveform.kind
        change = f"{fitting}, or hold the offset before it, in a sequence of hold and {kind}"
    low = min(excess.allowed[0], -_up(-span[0]))
    high = max(excess.allowed[1], _up(span[1]))
    wider = f"[{low!r}, {high!r}]"
    if limits.peak_current_a is not None:
        high = max(high, -low)
        low, wider = -high, f"{high:g}"
    if info.command_min <= low and high <= info.command_max:
        return change, f"raise {excess.problem.key} to {wider} if the actuator allows it"
    wider = f"{info.command_min:g} to {info.command_max:g} {info.command_unit}"
    return change, f"use a device with a larger range than {info.name}, {wider}"


def _of_slew(excess: Excess, course: Course) -> tuple[str, str]:
    return _SLOWER, f"raise {excess.problem.key} to {_up(course.forecast.slew_per_s):g}"


def _of_voltage(excess: Excess, course: Course) -> tuple[str, str]:
    forecast, amplifier = course.forecast, course.rig.amplifier
    assert amplifier is not None
    assert forecast.voltage_v is not None
    raised = f"use an amplifier of {_up(forecast.voltage_v):g} V"
    low, high = forecast.command_min, forecast.command_max
    if excess.at_s < forecast.before_s:
        return "lower the condition's frequency_hz or amplitude_a", raised
    if max(-low, high) > amplifier.held_a:
        held = f"{amplifier.voltage_max_v:g} V hold at most {amplifier.held_a:.4g} A"
        return f"lower amplitude or offset, because {held}", raised
    if excess.at_s > forecast.before_s:  # not the step to the first command
        # The voltage of the mean command does not decrease with the amplitude.
        alternating_v = forecast.voltage_v - amplifier.resistance_ohm * abs(0.5 * (low + high))
        if less := _smaller(course, 0.5 * (high - low) * excess.amount / alternating_v):
            return f"lower the frequency, {less}", raised
    return _SLOWER, raised


def _of_heat(excess: Excess, course: Course) -> tuple[str, str]:
    left_s = excess.at_s - course.forecast.before_s
    if abs(course.rig.command.safe) > excess.allowed[1]:
        return "lower safe.value", ""
    if left_s <= 0.0:
        return "lower the condition's amplitude or cycles", ""
    return f"lower the waveform's amplitude or offset, or end it within {-_up(-left_s):g} s", ""


_CHANGES: dict[str, Callable[[Excess, Course], tuple[str, str]]] = {
    "reference": _of_reference,
    "command": _of_command,
    "slew": _of_slew,
    "voltage": _of_voltage,
    "heat": _of_heat,
}
"""What to change in the waveform, and what in the limit instead; by what exceeds it."""


def _wait(course: Course) -> str:
    """Return how long the coil must cool before the run; empty if that is no cure."""
    begins_a, heat = course.forecast.begins_rms_a or 0.0, course.forecast.heat
    pause_s = CoolingCoil(course.rig, begins_a**2, 0.0).pause_s(heat, 0.0)
    if not (pause_s > 0.0 and heat.hottest_a2 > course.rig.command.safe**2):
        return ""
    return f"it begins at {begins_a:.3g} A rms, left by the last run: wait {pause_s:.0f} s"


def _at(course: Course, at_s: float) -> tuple[int, str]:
    """Return the number of the segment at a time, and the part of it; -1 in the conditioning."""
    segments = course.reference.segments
    sample = round((at_s - course.forecast.before_s) * course.reference.sample_rate_hz)
    if sample < 0:
        return -1, "the conditioning"
    number = next((i for i, each in enumerate(segments) if sample < each.stop), len(segments) - 1)
    segment = segments[number]
    if sample < segment.steady_start:
        return number, _SOFT_START
    return number, "" if sample < segment.steady_stop else _SOFT_END


def _place(course: Course, at_s: float) -> tuple[str, str]:
    """Return the time and part of a run in words, and the change of a soft end at that time."""
    segments, waveform = course.reference.segments, course.waveform
    number, part = _at(course, at_s)
    if number < 0:
        return f" at {at_s:.4g} s in {part}", ""
    key, then = "waveform", ""
    if waveform.kind == "sequence":
        parts = len(waveform.parts)
        key = f"waveform.parts.{number % parts}"
        if number + 1 < len(segments):
            then = f" and waveform.parts.{(number + 1) % parts}.soft_start_s"
    place = f" at {at_s:.4g} s in {part and f'{part} of '}{key}"
    if part != _SOFT_END:
        return place, ""
    change = f"set {key}.soft_end_s{then} to 0"
    return place, change if then else f"{change}, because the safe ramp follows"


def _smaller(course: Course, excess: float) -> str:
    """Return the amplitude whose commands are lower by an excess; empty if there is none."""
    forecast, amplitude = course.forecast, getattr(course.waveform, "amplitude", 0.0)
    if commanded := forecast.command_max - forecast.command_min:
        slope = (forecast.reference_max - forecast.reference_min) / commanded
        amplitude -= _MORE_SLOPE * slope * excess
    return f"set waveform.amplitude to {-_up(-amplitude):g}" if amplitude > 0.0 else ""


def _fitting(waveform: AnyWaveform, span: tuple[float, float], allowed: tuple[float, float]) -> str:
    """Return the changes with which a waveform with this span keeps to a range."""
    (low, high), (lowest, highest) = span, allowed
    fits, centred = high - low <= highest - lowest, lowest <= 0.5 * low + 0.5 * high <= highest
    size = "scale" if waveform.kind == "file" else "amplitude"
    if fits:
        return f"change the waveform's {f'{size} or offset' if centred else 'offset'}"
    return f"lower the waveform's {size}{'' if centred else ', and change its offset'}"


def _up(value: float) -> float:
    """Return a number rounded up to four digits."""
    return float(Context(prec=4, rounding=ROUND_CEILING).create_decimal_from_float(value))
