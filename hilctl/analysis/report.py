"""Report of a recording: metrics of the run and of each segment, in one pass over its samples."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import TypeAdapter, ValidationError

from hilctl.analysis import tick_lateness
from hilctl.analysis.run_metrics import AuxReport, RunReport, SegmentReport
from hilctl.analysis.steady_state import judged, loop_signals, trusted
from hilctl.analysis.tick_lateness import Quantiles
from hilctl.base.errors import DataError
from hilctl.base.events import ADAPTED, CHANGES, LOST_READINGS, MARK, ZERO, Event
from hilctl.base.samples import LAST_SAMPLE, NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment
from hilctl.base.strict import first_problem
from hilctl.base.types import F64, I64
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import END_FIGURES, USAGE_FACT
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics
from hilctl.signals.cycle_metrics import MeanCycle
from hilctl.signals.segment_metrics import SegmentMetrics

_LIMITED = Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID

_WORST = (*END_FIGURES, "peak_error_raw_percent", "rms_error_raw_percent")

Windows: TypeAlias = list[tuple[Segment, tuple[int, int, int]]]
"""Segments with their evaluated samples: first, after the last, whole cycles."""


def summarize(recording: Recording | Iterable[Recording]) -> RunReport:
    """Return the report of a recording, complete or truncated.

    For bounded memory, ``recording`` is the run's pieces in order as a repeatable iterable
    (:class:`hilctl.recording.reader.RecordingStream`): a run that ended early or was tuned is read
    twice. Raise DataError if a counter in the metadata of the end is not a number.
    """
    pieces = [recording] if isinstance(recording, Recording) else recording
    return build_report(pieces).report()


def build_report(
    pieces: Iterable[Recording],
    observe: Callable[[Windows], Callable[[Recording], None]] | None = None,
) -> "RunReportBuilder":
    """Return the builder of a report after the last piece; raise DataError without any piece.

    The pieces are read again if the evaluated samples turn out to differ from the planned ones.
    ``observe`` is called with the evaluated samples before each reading; it returns a function
    that is called with each piece.
    """
    windows: Windows | None = None
    while True:
        builder: RunReportBuilder | None = None
        for piece in pieces:
            if builder is None:
                builder = RunReportBuilder(piece, windows)
                add = observe(builder.windows) if observe else None
            builder.add(piece)
            if add:
                add(piece)
        if builder is None:
            raise DataError("no recording to evaluate")
        right = builder.right_windows()
        if windows is not None or right == builder.windows:
            return builder
        windows = right


def _windows(recording: Recording, events: Sequence[Event], end: int) -> Windows:
    """Return the segments with their evaluated samples."""
    return [(each, judged(each, events, end)) for each in recording.segments]


_KEPT = {*CHANGES, ADAPTED, LOST_READINGS, MARK, ZERO}
"""Codes of events that a report uses or lists."""


class RunReportBuilder:
    """Builder of a report from pieces of a run; planned windows are evaluated if None."""

    def __init__(self, first: Recording, windows: Windows | None) -> None:
        self.windows = windows if windows is not None else _windows(first, (), LAST_SAMPLE)
        self._last = first
        self._segments = [SegmentReportBuilder(first, *window) for window in self.windows]
        longest = max((segment.stop for segment in first.segments), default=0)
        self._ticks = tick_lateness.LatenessBuilder(longest / first.sample_rate_hz / 60.0)
        self._events: list[Event] = []
        self._counts: Counter[str] = Counter()
        self._waveform: tuple[int, int] | None = None
        self._command, self._displacement_um = _Extremes(), _Extremes()
        self._age_s = _Extremes()
        self._aux = [_Extremes() for _ in first.aux_channels]

    @np.errstate(over="ignore", invalid="ignore")  # of readings near the largest number
    def add(self, piece: Recording) -> None:
        """Take the next piece."""
        self._last = piece
        self._ticks.add(piece.ticks)
        self._events += [event for event in piece.events if event.code in _KEPT]
        if piece.samples.index.size:
            self._count(piece.samples)
            for segment in self._segments:
                segment.add(piece.samples)

    def _count(self, samples: Samples) -> None:
        waveform = (samples.flags & np.uint32(NO_WAVEFORM)) == 0
        index, flags = samples.index, samples.flags
        if not waveform.all():
            index, flags = index[waveform], flags[waveform]
        if index.size:
            first = self._waveform[0] if self._waveform else int(index[0])
            self._waveform = first, int(index[-1]) + 1
        self._counts["samples"] += index.size
        self._counts["recorded_samples"] += samples.index.size
        self._counts["limited_samples"] += int(np.count_nonzero(flags & np.uint32(_LIMITED)))
        invalid = flags & np.uint32(Flag.SENSOR_INVALID)
        self._counts["sensor_invalid_samples"] += int(np.count_nonzero(invalid))
        self._command.add(samples.command)
        self._displacement_um.add(samples.displacement_um)
        self._age_s.add(samples.reading_age_s)
        for found, values in zip(self._aux, samples.aux.T, strict=True):
            found.add(values)

    def right_windows(self) -> Windows:
        """Return the windows by the progress and tuning of the run, after the last piece."""
        return _windows(self._last, self._events, self._waveform[1] if self._waveform else 0)

    def cycles(self) -> list[MeanCycle | None]:
        """Return the average cycle of each segment, after the last piece; None without a period."""
        return [segment.cycle() for segment in self._segments]

    def report(self) -> RunReport:
        """Return the report, after the last piece."""
        segments, ticks, last = tuple(s.report() for s in self._segments), self._ticks, self._last
        adapted = [event.values for event in self._events if event.code == ADAPTED]
        lost = [event.values["readings"] for event in self._events if event.code == LOST_READINGS]
        zeros = [event.values["offset_um"] for event in self._events if event.code == ZERO]
        return RunReport(
            **_identity(last),
            **self._counted(),
            **_worst(segments),
            deadline_misses=tick_lateness.misses(last, ticks.late_ns.size),
            skipped_ticks=tick_lateness.counter(last, "skipped_ticks"),
            late_ticks=tick_lateness.counter(last, "late_ticks"),
            lateness_us=tick_lateness.percentiles_us(ticks.late_ns),
            lateness_by_minute=ticks.by_minute(),
            exchange_us=tick_lateness.percentiles_us(ticks.exchange_ns),
            busy_us=tick_lateness.percentiles_us(ticks.busy_ns),
            tick_us=tick_lateness.parts_us(last, ticks),
            period_us=None if ticks.period_ns is None else ticks.period_ns * 1e-3,
            processes=processes_of(last),
            adapted=dict(adapted[-1]) if adapted else {},
            lost_readings=round(sum(lost)),
            zero_um=zeros[-1] if zeros else None,
            marks=tuple(
                (event.sample / last.sample_rate_hz, event.text)
                for event in self._events
                if event.code == MARK
            ),
            segments=segments,
        )

    def _counted(self) -> dict[str, Any]:
        first, stop = self._waveform or (0, 0)
        end = max((segment.stop for segment in self._last.segments), default=0)
        names = ("samples", "recorded_samples", "limited_samples", "sensor_invalid_samples")
        counts = {name: self._counts[name] for name in names}
        return {
            **counts,
            # Skipped ticks may be the last ones.
            "complete": bool(self._last.end) and stop + self._last.dropped >= end,
            "ramp_samples": counts["recorded_samples"] - counts["samples"],
            "duration_s": (stop - first) / self._last.sample_rate_hz,
            "dropped": self._last.dropped,
            "command_min": self._command.low,
            "command_max": self._command.high,
            "displacement_min_um": self._displacement_um.low,
            "displacement_max_um": self._displacement_um.high,
            "reading_age_max_s": self._age_s.high,
            "aux": {
                channel.name: AuxReport(
                    channel.unit, channel.meaning, each.mean, each.low, each.high
                )
                for channel, each in zip(self._last.aux_channels, self._aux, strict=True)
            },
        }


class _Extremes:
    """Mean, lowest and highest of the finite values; None without any."""

    def __init__(self) -> None:
        self.low: float | None = None
        self.high: float | None = None
        self._sum, self._count = 0.0, 0

    @property
    def mean(self) -> float | None:
        return self._sum / self._count if self._count else None

    def add(self, column: F64) -> None:
        finite = np.isfinite(column)
        known = column if finite.all() else column[finite]
        if known.size:
            low, high = float(known.min()), float(known.max())
            self.low = low if self.low is None else min(self.low, low)
            self.high = high if self.high is None else max(self.high, high)
            self._sum += float(known.sum())
            self._count += known.size


def _identity(recording: Recording) -> dict[str, Any]:
    cut_short = "the recording is truncated: its end is missing"
    return {
        "path": str(recording.path),
        "name": recording.run.get("name", ""),
        "labels": recording.labels,
        "device": recording.run.get("device", ""),
        "device_description": recording.run.get("device_description", ""),
        "simulated": recording.run.get("simulated") == "true",
        "reason": recording.end.get("reason", "") if recording.end else cut_short,
        "sample_rate_hz": recording.sample_rate_hz,
        "compensated": recording.compensated,
        "command_unit": recording.command_unit,
        "loop_area_unit": f"um*{'um' if recording.compensated else recording.command_unit}",
    }


def worst_segment(segments: Sequence[SegmentReport]) -> int:
    """Return the number of the segment with the largest peak hysteresis, otherwise peak error."""
    figures = [(s.peak_hysteresis_percent or 0.0, s.peak_error_percent or 0.0) for s in segments]
    return figures.index(max(figures)) if figures else 0


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
    figures["settled"] = all(each.settled for each in segments)
    return figures


def _pooled_noise_um(segments: Sequence[SegmentReport]) -> float | None:
    """Return the rms over the segments, weighted by their samples."""
    known = [s for s in segments if s.sensor_noise_um is not None]
    if not known:
        return None
    squares = np.array([s.sensor_noise_um for s in known], dtype=np.float64) ** 2
    return float(np.sqrt(np.average(squares, weights=[s.steady_samples for s in known])))


_PROCESSES = TypeAdapter(dict[Literal["loop", "supervisor"], ProcessUsage])
_USAGE_LIMIT = 2**63


def processes_of(recording: Recording) -> dict[str, ProcessUsage]:
    """Return the resource usage of ``loop`` and ``supervisor``; empty if it is not recorded."""
    where = f"{recording.path}: hilctl.end: {USAGE_FACT}"
    try:
        found = _PROCESSES.validate_json(recording.end.get(USAGE_FACT, "{}"))
    except ValidationError as error:
        raise DataError(f"{where}: {first_problem(error)}") from None
    if any(not 0 <= value < _USAGE_LIMIT for each in found.values() for value in astuple(each)):
        raise DataError(f"{where}: every number must be in [0, 2^63)")
    return {str(name): usage for name, usage in found.items()}


class SegmentReportBuilder:
    """Builder of the report of a segment from its evaluated samples."""

    def __init__(
        self, recording: Recording, segment: Segment, window: tuple[int, int, int]
    ) -> None:
        self._rate_hz = recording.sample_rate_hz
        self._compensated = compensated = recording.compensated
        self._segment = segment
        self._start, self._stop, self._cycles = window
        averaged = self._cycles > 0
        self._metrics = SegmentMetrics(segment, averaged=averaged, compensated=compensated)
        self._samples = self._steady = 0
        self._noise = _Noise()

    def add(self, samples: Samples) -> None:
        """Add the next samples of the run; at least one."""
        segment = self._segment
        if samples.index[-1] < segment.start or samples.index[0] >= segment.stop:
            return  # each piece overlaps one or two of maybe a thousand segments
        first, end = np.searchsorted(samples.index, (segment.start, segment.stop)).tolist()
        self._samples += end - first
        part = trusted(samples.part(self._start, self._stop))
        if part.index.size == 0:
            return
        self._steady += part.index.size
        self._metrics.add(part.index, loop_signals(part, compensated=self._compensated))
        if segment.period <= 0.0 or segment.period >= cycle_metrics.SHORTEST_PERIOD:
            self._noise.add(part.index, part.displacement_um)

    def cycle(self) -> cycle_metrics.MeanCycle | None:
        """Return the average cycle of the loop's input and output; None without a period."""
        return self._metrics.cycle()

    def report(self) -> SegmentReport:
        """Return the metrics; None for those that are not available."""
        period, noise_um = self._segment.period, self._noise.rms_um()
        found = self._metrics.metrics(noise_um)
        return SegmentReport(
            label=self._segment.label,
            start_s=self._segment.start / self._rate_hz,
            frequency_hz=self._rate_hz / period if period > 0.0 else None,
            samples=self._samples,
            steady_cycles=self._cycles,
            steady_samples=self._steady,
            settled=self._start - self._segment.steady_start >= period - 1.0,
            sensor_noise_um=noise_um,
            **{name: found.get(name) for name in (*_WORST, "noise_floor_percent")},
        )


class _Noise:
    """Sensor noise across pieces, see :func:`hilctl.signals.cycle_metrics.sensor_noise_um`."""

    def __init__(self) -> None:
        self._windows = Quantiles()
        self._index = np.empty(0, dtype=np.int64)
        self._displacement_um = np.empty(0)

    def add(self, index: I64, displacement_um: F64) -> None:
        finite = np.isfinite(displacement_um)
        if not finite.all():
            index, displacement_um = index[finite], displacement_um[finite]
        index = np.concatenate((self._index, index))
        displacement_um = np.concatenate((self._displacement_um, displacement_um))
        if index.size > cycle_metrics.NOISE_OVERLAP:
            self._windows.add(cycle_metrics.noise_windows_um(index, displacement_um))
        self._index = index[-cycle_metrics.NOISE_OVERLAP :]
        self._displacement_um = displacement_um[-cycle_metrics.NOISE_OVERLAP :]

    def rms_um(self) -> float | None:
        if not self._windows.size:
            return None
        return cycle_metrics.noise_of(self._windows.median(), self._windows.size)
