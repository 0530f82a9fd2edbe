"""From a recording to a report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hilctl.analysis import metrics, noise, timing
from hilctl.analysis.figures import RunReport, SegmentReport
from hilctl.analysis.steady import SteadyPart, error_um, steady_part, waveform_end
from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment
from hilctl.recording.data import Recording

_WORST = (
    "peak_hysteresis_percent",
    "loop_area",
    "peak_to_peak_um",
    "peak_error_percent",
    "rms_error_percent",
    "peak_error_raw_percent",
    "rms_error_raw_percent",
)


@np.errstate(over="ignore", invalid="ignore")  # of readings near the end of all numbers
def summarize(recording: Recording) -> RunReport:
    """Work out all figures that a recording allows; one cut short gives those of what it holds.

    Raises:
        DataError: A counter in the record of the end is not a number.
    """
    segments = tuple(judge(recording, segment) for segment in recording.segments)
    return RunReport(
        **_identity(recording),
        **_counts(recording),
        **_extremes(recording),
        **_worst(segments),
        lateness_us=timing.percentiles_us(recording.ticks.late_ns),
        lateness_by_minute=timing.by_minute(recording.ticks),
        exchange_us=timing.percentiles_us(recording.ticks.exchange_ns),
        segments=segments,
    )


def judge(recording: Recording, segment: Segment) -> SegmentReport:
    """Work out the figures of one segment; None where it has not been reached."""
    part = steady_part(recording, segment)
    repeats = segment.period > 0.0
    peak_to_peak_um = _peak_to_peak_um(part, repeats)
    errors = _errors(part, peak_to_peak_um) if recording.compensated else {}
    return SegmentReport(
        label=segment.label,
        start_s=segment.start / recording.sample_rate_hz,
        frequency_hz=recording.sample_rate_hz / segment.period if repeats else None,
        samples=recording.samples.part(segment.start, segment.stop).index.size,
        steady_cycles=part.cycles,
        steady_samples=part.samples.index.size,
        peak_to_peak_um=peak_to_peak_um,
        peak_error_percent=errors.get("peak"),
        rms_error_percent=errors.get("rms"),
        peak_error_raw_percent=errors.get("peak_raw"),
        rms_error_raw_percent=errors.get("rms_raw"),
        **_loop_and_noise(part, segment.period),
    )


def _peak_to_peak_um(part: SteadyPart, repeats: bool) -> float | None:
    """Return that of the average cycle; where nothing repeats, of the samples."""
    if part.cycle is not None:
        return metrics.peak_to_peak(part.cycle.signals[1])
    displacement_um = part.samples.displacement_um
    finite = displacement_um[np.isfinite(displacement_um)]
    return None if repeats or finite.size == 0 else metrics.peak_to_peak(finite)


def _errors(part: SteadyPart, peak_to_peak_um: float | None) -> dict[str, float | None]:
    raw_um = error_um(part)
    if peak_to_peak_um is None or raw_um.size == 0:
        return {}
    raw = _peak_and_rms(raw_um, peak_to_peak_um)
    if part.cycle is not None:
        reference_um, displacement_um = part.cycle.signals
        average = _peak_and_rms(displacement_um - reference_um, peak_to_peak_um)
    else:
        average = raw
    return {"peak": average[0], "rms": average[1], "peak_raw": raw[0], "rms_raw": raw[1]}


def _peak_and_rms(error: F64, whole: float) -> tuple[float | None, float | None]:
    return (
        metrics.percent(metrics.peak(error), whole),
        metrics.percent(metrics.rms(error), whole),
    )


def _loop_and_noise(part: SteadyPart, period: float) -> dict[str, float | None]:
    figures: dict[str, float | None] = dict.fromkeys(
        ("peak_hysteresis_percent", "loop_area", "sensor_noise_um", "noise_floor_percent")
    )
    if period <= 0.0 or period >= noise.SHORTEST_PERIOD:
        samples = part.samples
        figures["sensor_noise_um"] = noise.sensor_noise_um(samples.index, samples.displacement_um)
    if part.cycle is None:
        return figures
    loop_input, output = part.cycle.signals
    figures["peak_hysteresis_percent"] = metrics.peak_hysteresis_percent(loop_input, output)
    figures["loop_area"] = metrics.loop_area(loop_input, output)
    noise_um = figures["sensor_noise_um"]
    if noise_um is not None:
        whole = metrics.peak_to_peak(output)
        floor = noise.noise_floor_percent(noise_um, part.cycle.counts, whole)
        figures["noise_floor_percent"] = floor
    return figures


def _identity(recording: Recording) -> dict[str, Any]:
    end = max((segment.stop for segment in recording.segments), default=0)
    cut_short = "the recording is cut short: its end was not recorded"
    return {
        "path": str(recording.path),
        "name": recording.run.get("name", ""),
        "device": recording.run.get("device", ""),
        "simulated": recording.run.get("simulated") == "true",
        "reason": recording.end.get("reason", "") if recording.end else cut_short,
        "complete": bool(recording.end) and waveform_end(recording.samples) >= end,
        "sample_rate_hz": recording.sample_rate_hz,
        "compensated": recording.compensated,
        "command_unit": recording.command_unit,
        "loop_area_unit": f"um*{'um' if recording.compensated else recording.command_unit}",
    }


def _counts(recording: Recording) -> dict[str, Any]:
    samples = recording.samples
    waveform = (samples.flags & Flag.RAMP) == 0
    index, flags = samples.index[waveform], samples.flags[waveform]
    span = int(index[-1] - index[0]) + 1 if index.size else 0
    limited = Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID
    return {
        "samples": index.size,
        "ramp_samples": samples.index.size - index.size,
        "recorded_samples": samples.index.size,
        "duration_s": span / recording.sample_rate_hz,
        "dropped": recording.dropped,
        "skipped_ticks": _counter(recording, "skipped_ticks", None),
        "limited_samples": int(np.count_nonzero(flags & limited)),
        "sensor_invalid_samples": int(np.count_nonzero(flags & Flag.SENSOR_INVALID)),
        "late_ticks": _counter(recording, "late_ticks", timing.late_ticks(recording.ticks)),
    }


def _counter(recording: Recording, name: str, otherwise: int | None) -> int | None:
    """Return a counter from the record of the end, or what was counted here."""
    if name not in recording.end:
        return otherwise
    try:
        return int(recording.end[name])
    except ValueError:
        text = f"{recording.path}: hilctl.end: {name} must be a whole number"
        raise DataError(f"{text}, got {recording.end[name]!r}") from None


def _extremes(recording: Recording) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    columns = {
        ("command_min", "command_max"): recording.samples.command,
        ("displacement_min_um", "displacement_max_um"): recording.samples.displacement_um,
    }
    for (lowest, highest), column in columns.items():
        finite = column[np.isfinite(column)]
        figures[lowest] = float(finite.min()) if finite.size else None
        figures[highest] = float(finite.max()) if finite.size else None
    return figures


def worst_segment(segments: Sequence[SegmentReport]) -> int:
    """Return the number of the segment with the largest peak hysteresis; 0 where none has any."""
    heights = [segment.peak_hysteresis_percent or 0.0 for segment in segments]
    return heights.index(max(heights)) if heights else 0


def _worst(segments: Sequence[SegmentReport]) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for name in _WORST:
        known = [value for each in segments if (value := getattr(each, name)) is not None]
        figures[name] = max(known, default=None)
    worst = segments[worst_segment(segments)] if segments else None
    figures["noise_floor_percent"] = worst.noise_floor_percent if worst else None
    figures["sensor_noise_um"] = _pooled_noise_um(segments)
    figures["steady_cycles"] = sum(each.steady_cycles for each in segments)
    figures["steady_samples"] = sum(each.steady_samples for each in segments)
    return figures


def _pooled_noise_um(segments: Sequence[SegmentReport]) -> float | None:
    """Return the rms over the segments, each weighing as many samples as it has."""
    known = [s for s in segments if s.sensor_noise_um is not None]
    if not known:
        return None
    squares = np.array([s.sensor_noise_um for s in known], dtype=np.float64) ** 2
    return float(np.sqrt(np.average(squares, weights=[s.steady_samples for s in known])))
