"""Running metrics of the newest samples: complete cycles, error spectrum, lateness, use of limits.

Metrics of cycles are computed with the functions of a report. Without a period, the metrics that
need none are computed over the newest half second.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hilctl.base.samples import NO_WAVEFORM, BlockBatch, BlockHeader, Flag
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.live.scope import ROW, SIGNALS, Traces
from hilctl.run.metadata import LimitBounds, RunDescription
from hilctl.signals.cycle_metrics import sensor_noise_um
from hilctl.signals.segment_metrics import SegmentMetrics

WARNING_USED, ERROR_USED = 0.8, 0.95
"""Used fractions of a limit above which a gauge is a warning or an error."""
_HOLD_S = 1.0
_HELD = ("command", "slew", "displacement", "tracking error", "measured - command")


@dataclass(frozen=True, slots=True)
class Gauge:
    """Use of one limit."""

    name: str
    used: float  # fraction of the limit in use; more than 1 if it is exceeded
    value: float
    limit: float
    unit: str  # of value and limit

    @property
    def level(self) -> Literal["info", "warning", "error"]:
        """Severity to display."""
        if self.used > ERROR_USED:
            return "error"
        return "warning" if self.used > WARNING_USED else "info"


class Headroom:
    """The limits of one run; each gauge holds the peak of the last second."""

    def __init__(self, description: RunDescription) -> None:
        self._limits: LimitBounds = description.limits
        self._rate_hz, self._unit = description.sample_rate_hz, description.command_unit
        self._heat_a2 = self._limits.heat_a2
        self._before = np.empty((2, 0))
        self._next_sample = 0
        self._aux = [*enumerate(description.aux, len(SIGNALS))]
        names = (*_HELD, *(each.name for _, each in self._aux))
        self._held: dict[str, list[tuple[int, Gauge]]] = {name: [] for name in names}

    def add(self, traces: Traces) -> None:
        """Add the next samples."""
        if not traces.index.size:
            return
        command, measured = traces.values[ROW["command"]], traces.values[ROW["measured"]]
        limits, unit = self._limits, self._unit
        self._next_sample = int(traces.index[-1]) + 1
        self._range("command", command, limits.command, unit)
        # With the last sample before them.
        moves = np.concatenate((self._before, (traces.index, command)), axis=1)
        self._before = moves[:, -1:]
        slews_per_s = np.diff(moves[1]) / np.diff(moves[0]) * self._rate_hz
        self._most("slew", np.abs(slews_per_s), limits.slew_per_s, f"{unit}/s")
        self._range("displacement", traces.values[ROW["displacement"]], limits.stroke_um, "um")
        error_um = np.abs(traces.values[ROW["error"]])
        self._most("tracking error", error_um, limits.tracking_error_um, "um")
        deviation = np.abs(measured - command)
        self._most("measured - command", deviation, limits.measured_deviation, unit)
        for row, each in self._aux:
            if each.low is None:
                self._most(each.name, traces.values[row], each.high, each.unit)
            elif each.high is not None:
                self._range(each.name, traces.values[row], [each.low, each.high], each.unit)
        if limits.thermal_time_constant_s is not None:
            current_a = np.fmax(np.abs(command), np.abs(measured))
            stays = math.exp(-1.0 / (limits.thermal_time_constant_s * self._rate_hz))
            weights = stays ** np.arange(current_a.size - 1, -1, -1)
            heat_a2 = (1.0 - stays) * float(np.nansum(weights * np.square(current_a)))
            self._heat_a2 = self._heat_a2 * stays**current_a.size + heat_a2

    def gauges(self, late_s: float) -> list[Gauge]:
        """Return the gauges; ``late_s`` is the largest lateness of the newest ticks."""
        limits = self._limits
        held = [[gauge for _, gauge in each] for each in self._held.values()]
        found = [max(each, key=lambda gauge: gauge.used) for each in held if each]
        if limits.rms_current_a is not None:
            rms_a = math.sqrt(self._heat_a2)
            used = rms_a / limits.rms_current_a
            found.append(Gauge("coil heat", used, rms_a, limits.rms_current_a, "A rms"))
        found.append(Gauge("late tick", late_s / limits.late_s, late_s, limits.late_s, "s"))
        return found

    def _range(self, name: str, values: F64, bounds: list[float], unit: str) -> None:
        values = values[np.isfinite(values)]
        if values.size:
            middle, half = (bounds[0] + bounds[1]) / 2.0, (bounds[1] - bounds[0]) / 2.0
            value = float(values[np.abs(values - middle).argmax()])
            limit = max(map(abs, bounds))
            self._hold(Gauge(name, abs(value - middle) / half, value, limit, unit))

    def _most(self, name: str, values: F64, limit: float | None, unit: str) -> None:
        values = values[np.isfinite(values)]
        if limit and values.size:
            most = float(values.max())
            self._hold(Gauge(name, max(most / limit, 0.0), most, limit, unit))

    def _hold(self, gauge: Gauge) -> None:
        oldest = self._next_sample - _HOLD_S * self._rate_hz
        # A value smaller than a later one can never become the maximum.
        kept = [
            (at, each)
            for at, each in self._held[gauge.name]
            if at > oldest and each.used > gauge.used
        ]
        self._held[gauge.name] = [*kept, (self._next_sample, gauge)]


MetricValues: TypeAlias = dict[str, float | None]
_GROUP_S = 0.5
_NOISE_SAMPLES = 4096
_LEFT_OUT = NO_WAVEFORM | Flag.SENSOR_INVALID
_SPECTRUM_SAMPLES = 16384
_SPECTRUM_POINTS = 240
EDGES_US: F64 = np.concatenate(([0.0], np.geomspace(1.0, 1e6, 31)))
"""Edges of the histogram's bins; later ticks are in the last bin."""
_TICKS = 20_000


class RunningMetrics:
    """Running metrics of one run; ``loop_input`` is the signal on the abscissa of its loop."""

    def __init__(self, sample_rate_hz: float, loop_input: str) -> None:
        self._rate_hz, self._input = sample_rate_hz, ROW[loop_input]
        self._compensated = loop_input == "reference"
        self._segment: Segment | None = None
        self._group: _Group | None = None
        self.newest: MetricValues = {}
        """Metrics of the last complete group of cycles by name with unit."""

    def add(self, traces: Traces, segment: Segment | None) -> None:
        """Add the next samples; ``segment`` is that of the newest."""
        if segment is None:
            return
        if segment is not self._segment:
            self._segment, self._group = segment, None
        # Not the soft end: the metrics of the last steady cycles stay visible.
        traces = traces.part(0, segment.steady_stop)
        while traces.index.size:
            if self._group is None:
                self._group = self._begin(segment, int(traces.index[0]))
            group = self._group
            group.add(traces.part(group.start, group.stop), self._input)
            if traces.index[-1] < group.stop - 1:
                return
            self.newest = group.metrics() or self.newest
            traces, self._group = traces.part(group.stop, math.inf), None

    def _begin(self, segment: Segment, sample: int) -> "_Group":
        """Return the next group: complete cycles from the start of a cycle."""
        if segment.period <= 0.0:
            start = max(sample, segment.start)
            stop = min(start + max(1, round(_GROUP_S * self._rate_hz)), segment.steady_stop)
            return _Group(start, stop, segment, compensated=self._compensated)
        passed = math.ceil(max(0, sample - segment.start) / segment.period - 1e-9)
        left = math.floor((segment.steady_stop - segment.start) / segment.period - passed + 1e-9)
        cycles = max(1, min(round(_GROUP_S * self._rate_hz / segment.period), left))
        start = segment.start + math.ceil(passed * segment.period - 1e-9)
        stop = segment.start + math.ceil((passed + cycles) * segment.period - 1e-9)
        return _Group(start, stop, segment, compensated=self._compensated)


class _Group:
    """Consecutive cycles of a segment: the samples in [start, stop)."""

    def __init__(self, start: int, stop: int, segment: Segment, *, compensated: bool) -> None:
        self.start, self.stop = start, stop
        averaged = segment.period > 0.0
        self._metrics = SegmentMetrics(segment, averaged=averaged, compensated=compensated)
        self._index: I64 = np.empty(0, dtype=np.int64)
        self._displacement_um: F64 = np.empty(0)

    def add(self, traces: Traces, loop_input: int) -> None:
        """Add samples; one row is the input of the loop."""
        kept = (traces.flags & _LEFT_OUT) == 0
        index, displacement_um = traces.index[kept], traces.values[ROW["displacement"], kept]
        self._metrics.add(index, np.array((traces.values[loop_input, kept], displacement_um)))
        self._index = np.concatenate((self._index, index))[-_NOISE_SAMPLES:]
        newest_um = np.concatenate((self._displacement_um, displacement_um))
        self._displacement_um = newest_um[-_NOISE_SAMPLES:]

    def metrics(self) -> MetricValues:
        """Return the metrics; none without a displacement."""
        if not (raw := self._metrics.raw()):
            return {}
        noise_um = sensor_noise_um(self._index, self._displacement_um)
        return {"sensor_noise_um": noise_um, **raw, **self._metrics.metrics(noise_um)}


class LiveErrorSpectrum:
    """Amplitude spectrum of the newest samples of the error."""

    def __init__(self, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._newest = np.empty(0)

    def add(self, traces: Traces) -> None:
        """Add the next samples; a gap or a missing error discards all earlier ones."""
        error_um = traces.values[ROW["error"]]
        broken = ~np.isfinite(error_um)
        if broken.any():
            last = int(np.flatnonzero(broken)[-1])
            self._newest, error_um = np.empty(0), error_um[last + 1 :]
        self._newest = np.concatenate((self._newest, error_um))[-_SPECTRUM_SAMPLES:]

    def points(self) -> tuple[F64, F64]:
        """Return frequencies in Hz and amplitudes in um, each the maximum of adjacent lines.

        Both float64[k]; empty before there are 256 samples. A sine of 1 um has a line of 1 um.
        """
        size = 1 << (self._newest.size.bit_length() - 1) if self._newest.size else 0
        if size < 256:
            return np.empty(0), np.empty(0)
        window = np.hanning(size)
        error_um = self._newest[-size:]
        lines_um = np.abs(np.fft.rfft((error_um - error_um.mean()) * window))
        lines_um *= 2.0 / window.sum()
        # Maximum, so that a single line remains visible.
        edges = np.unique(np.geomspace(1, lines_um.size, _SPECTRUM_POINTS).astype(np.int64))[:-1]
        largest_um: F64 = np.maximum.reduceat(lines_um, edges)
        return edges.astype(np.float64) * np.float64(self._rate_hz / size), largest_um


class LatenessCounts:
    """Histogram of the lateness of all ticks read, and percentiles of the newest."""

    def __init__(self) -> None:
        self.counts: I64 = np.zeros(EDGES_US.size - 1, dtype=np.int64)
        self._newest_us: F64 = np.empty(0)

    def add(self, batch: BlockBatch) -> None:
        """Add the next blocks."""
        late_us = np.maximum(batch.heads[:, BlockHeader.LATE_NS] * 1e-3, 0.0)
        self.counts += np.histogram(np.minimum(late_us, EDGES_US[-1]), EDGES_US)[0]
        self._newest_us = np.concatenate((self._newest_us, late_us))[-_TICKS:]

    def percentiles_us(self) -> dict[str, float]:
        """Return ``p50``, ``p99`` and ``max`` of the newest ticks; empty before the first."""
        if not self._newest_us.size:
            return {}
        p50, p99, most = np.percentile(self._newest_us, (50.0, 99.0, 100.0))
        return {"p50": float(p50), "p99": float(p99), "max": float(most)}
