"""From a recording to a report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hilctl.analysis import timing
from hilctl.analysis.figures import RunReport, SegmentReport
from hilctl.analysis.steady import steady_part
from hilctl.base import metrics
from hilctl.base.arrays import F64
from hilctl.base.events import ADAPTED, MARK
from hilctl.base.samples import NO_WAVEFORM, Flag
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
        **_worst(segments),
        **_timing(recording),
        adapted=_adapted(recording),
        marks=tuple(
            (event.sample / recording.sample_rate_hz, event.text)
            for event in recording.events
            if event.code == MARK
        ),
        segments=segments,
    )


def judge(recording: Recording, segment: Segment) -> SegmentReport:
    """Work out the figures of one segment; None where it has not been reached."""
    part = steady_part(recording, segment)
    samples, (loop_input, output) = part.samples, part.loop
    repeats = segment.period > 0.0
    stroke_um, (peak, rms), (peak_raw, rms_raw) = None, (None, None), (None, None)
    if output.size:
        stroke_um = metrics.peak_to_peak(output)
        if recording.compensated:
            peak, rms = metrics.peak_and_rms_percent(output - loop_input, stroke_um)
            peak_raw, rms_raw = metrics.peak_and_rms_percent(part.raw_error_um, stroke_um)
    noise_um = hysteresis = area = floor = None
    if not repeats or segment.period >= metrics.SHORTEST_PERIOD:
        noise_um = metrics.sensor_noise_um(samples.index, samples.displacement_um)
    if part.cycle is not None:
        hysteresis = metrics.peak_hysteresis_percent(loop_input, output)
        area = metrics.loop_area(loop_input, output)
        if noise_um is not None and stroke_um is not None:
            floor = metrics.noise_floor_percent(noise_um, part.cycle.counts, stroke_um)
    return SegmentReport(
        label=segment.label,
        start_s=segment.start / recording.sample_rate_hz,
        frequency_hz=recording.sample_rate_hz / segment.period if repeats else None,
        samples=recording.samples.part(segment.start, segment.stop).index.size,
        steady_cycles=part.cycles,
        steady_samples=samples.index.size,
        peak_to_peak_um=stroke_um,
        peak_error_percent=peak,
        rms_error_percent=rms,
        peak_error_raw_percent=peak_raw,
        rms_error_raw_percent=rms_raw,
        peak_hysteresis_percent=hysteresis,
        loop_area=area,
        sensor_noise_um=noise_um,
        noise_floor_percent=floor,
    )


def _identity(recording: Recording) -> dict[str, Any]:
    cut_short = "the recording is cut short: its end was not recorded"
    return {
        "path": str(recording.path),
        "name": recording.run.get("name", ""),
        "labels": recording.labels,
        "device": recording.run.get("device", ""),
        "simulated": recording.run.get("simulated") == "true",
        "reason": recording.end.get("reason", "") if recording.end else cut_short,
        "sample_rate_hz": recording.sample_rate_hz,
        "compensated": recording.compensated,
        "command_unit": recording.command_unit,
        "loop_area_unit": f"um*{'um' if recording.compensated else recording.command_unit}",
    }


def _counts(recording: Recording) -> dict[str, Any]:
    samples = recording.samples
    waveform = (samples.flags & NO_WAVEFORM) == 0
    index, flags = samples.index[waveform], samples.flags[waveform]
    first, stop = (int(index[0]), int(index[-1]) + 1) if index.size else (0, 0)
    end = max((segment.stop for segment in recording.segments), default=0)
    limited = Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID
    command_min, command_max = _extremes(samples.command)
    displacement_min_um, displacement_max_um = _extremes(samples.displacement_um)
    return {
        "complete": bool(recording.end) and stop >= end,
        "samples": index.size,
        "ramp_samples": samples.index.size - index.size,
        "recorded_samples": samples.index.size,
        "duration_s": (stop - first) / recording.sample_rate_hz,
        "dropped": recording.dropped,
        "limited_samples": int(np.count_nonzero(flags & limited)),
        "sensor_invalid_samples": int(np.count_nonzero(flags & Flag.SENSOR_INVALID)),
        "command_min": command_min,
        "command_max": command_max,
        "displacement_min_um": displacement_min_um,
        "displacement_max_um": displacement_max_um,
    }


def _extremes(column: F64) -> tuple[float | None, float | None]:
    finite = column[np.isfinite(column)]
    return (float(finite.min()), float(finite.max())) if finite.size else (None, None)


def _adapted(recording: Recording) -> dict[str, float]:
    found = [event.values for event in recording.events if event.code == ADAPTED]
    return dict(found[-1]) if found else {}


def _timing(recording: Recording) -> dict[str, Any]:
    ticks = recording.ticks
    return {
        "deadline_misses": timing.misses(recording),
        "skipped_ticks": timing.counter(recording, "skipped_ticks", None),
        "late_ticks": timing.counter(recording, "late_ticks", timing.late_ticks(ticks)),
        "lateness_us": timing.percentiles_us(ticks.late_ns),
        "lateness_by_minute": timing.by_minute(ticks),
        "exchange_us": timing.percentiles_us(ticks.exchange_ns),
    }


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
