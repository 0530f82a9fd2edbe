"""Cures for an exceeded limit: where a run exceeds it, and what in the experiment to change."""

from dataclasses import dataclass
from decimal import ROUND_CEILING, Context

from hilctl.experiment.forecast import Forecast
from hilctl.waveforms.build import Reference
from hilctl.waveforms.spec import AnyWaveform

SLOWER = "lower frequency or amplitude, soften jumps (soft_start_s, soft_end_s, rise_s)"
_MORE_SLOPE = 1.5  # of a loop at its ends, than on average


@dataclass(frozen=True, slots=True)
class Course:
    """A waveform and the commands that it needs.

    Attributes:
        reference: Samples of the waveform; None for the bound of a changed one.
    """

    waveform: AnyWaveform
    forecast: Forecast
    reference: Reference | None = None


def cure(excess: str, course: Course, at_s: float, change: str, raised: str = "") -> str:
    """Return how far a limit is exceeded, when, and what to change.

    ``change`` is the change of the waveform unless a soft end is the cause; ``raised`` is that of
    the limit itself.
    """
    place, soft_end = _place(course, at_s)
    otherwise = f", or {raised}" if raised else ""
    return f"{excess} too much{place}: {soft_end or change}{otherwise}"


def _place(course: Course, at_s: float) -> tuple[str, str]:
    """Return the time and part of a run in words, and the change of a soft end at that time."""
    if course.reference is None:
        return "", ""
    rate_hz, segments = course.reference.sample_rate_hz, course.reference.segments
    sample = round((at_s - course.forecast.before_s) * rate_hz)
    if sample < 0:
        return f" at {at_s:.4g} s in the conditioning", ""
    number = next((i for i, each in enumerate(segments) if sample < each.stop), len(segments) - 1)
    segment, waveform = segments[number], course.waveform
    key, then = "waveform", ""
    if waveform.kind == "sequence":
        parts = len(waveform.parts)
        key = f"waveform.parts.{number % parts}"
        if number + 1 < len(segments):
            then = f" and waveform.parts.{(number + 1) % parts}.soft_start_s"
    if sample < segment.steady_start:
        return f" at {at_s:.4g} s in the soft start of {key}", ""
    if sample < segment.steady_stop:
        return f" at {at_s:.4g} s in {key}", ""
    change = f"set {key}.soft_end_s{then} to 0"
    change += "" if then else ", because the safe ramp follows"
    return f" at {at_s:.4g} s in the soft end of {key}", change


def smaller(course: Course, excess: float) -> str:
    """Return the amplitude whose commands are lower by an excess; empty if there is none."""
    forecast, amplitude = course.forecast, getattr(course.waveform, "amplitude", 0.0)
    if commanded := forecast.command_max - forecast.command_min:
        slope = (forecast.reference_max - forecast.reference_min) / commanded
        amplitude -= _MORE_SLOPE * slope * excess
    return f"set waveform.amplitude to {-rounded_up(-amplitude):g}" if amplitude > 0.0 else ""


def fitting(waveform: AnyWaveform, span: tuple[float, float], limits: tuple[float, float]) -> str:
    """Return the changes with which a waveform with this span keeps to limits."""
    low, high = span
    lowest, highest = limits
    fits, centred = high - low <= highest - lowest, lowest <= 0.5 * low + 0.5 * high <= highest
    size = "scale" if waveform.kind == "file" else "amplitude"
    if fits:
        return f"change the waveform's {f'{size} or offset' if centred else 'offset'}"
    return f"lower the waveform's {size}{'' if centred else ', and change its offset'}"


def rounded_up(value: float) -> float:
    """Return a number rounded up to four digits."""
    return float(Context(prec=4, rounding=ROUND_CEILING).create_decimal_from_float(value))
