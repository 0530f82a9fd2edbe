"""Compute running metrics of the newest complete cycles with the functions of a report.

Without a period, the metrics that need none are computed over the newest half second.
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.samples import NO_WAVEFORM, Flag
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.live.signals import ROW, Traces
from hilctl.signals.cycle_metrics import (
    CycleAverager,
    noise_floor_percent,
    peak,
    peak_hysteresis_percent,
    peak_to_peak,
    percent,
    rms,
    sensor_noise_um,
)

FigureValues: TypeAlias = dict[str, float | None]
_GROUP_S = 0.5
_NOISE_SAMPLES = 4096
_LEFT_OUT = NO_WAVEFORM | Flag.SENSOR_INVALID


class RunningFigures:
    """Running metrics of one run.

    Args:
        sample_rate_hz: Samples per second.
        loop_input: Signal on the abscissa of the loop.
    """

    def __init__(self, sample_rate_hz: float, loop_input: str) -> None:
        self._rate_hz, self._input = sample_rate_hz, ROW[loop_input]
        self._segment: Segment | None = None
        self._group: _Group | None = None
        self.newest: FigureValues = {}
        """Those of the last group of cycles that is whole, by name with unit; empty before."""

    def add(self, traces: Traces, segment: Segment | None) -> None:
        """Add the next samples.

        Args:
            traces: The samples.
            segment: Segment of the newest sample.
        """
        if segment is None:
            return
        if segment is not self._segment:
            self._segment, self._group = segment, None
        while traces.index.size:
            if self._group is None:
                self._group = self._begin(segment, int(traces.index[0]))
            group = self._group
            group.add(traces.part(group.start, group.stop), self._input)
            if traces.index[-1] < group.stop - 1:
                return
            self.newest = group.figures() or self.newest
            traces, self._group = traces.part(group.stop, math.inf), None

    def _begin(self, segment: Segment, sample: int) -> "_Group":
        """Return the next group: complete cycles from the start of a cycle."""
        if segment.period <= 0.0:
            start = max(sample, segment.start)
            return _Group(start, start + max(1, round(_GROUP_S * self._rate_hz)), segment)
        cycles = max(1, round(_GROUP_S * self._rate_hz / segment.period))
        passed = math.ceil(max(0, sample - segment.start) / segment.period - 1e-9)
        start = segment.start + math.ceil(passed * segment.period - 1e-9)
        stop = segment.start + math.ceil((passed + cycles) * segment.period - 1e-9)
        return _Group(start, stop, segment)


class _Group:
    """Consecutive cycles.

    Args:
        start: First sample.
        stop: Sample after the last.
        segment: Segment of the cycles.
    """

    def __init__(self, start: int, stop: int, segment: Segment) -> None:
        self.start, self.stop = start, stop
        self._origin, period = segment.start, segment.period
        self._folding = CycleAverager(period, 2) if period > 0.0 else None
        self._peak_um = self._squares_um2 = 0.0
        self._low_um, self._high_um = math.inf, -math.inf
        self._errors = 0
        self._index: I64 = np.empty(0, dtype=np.int64)
        self._displacement_um: F64 = np.empty(0)

    def add(self, traces: Traces, loop_input: int) -> None:
        """Add samples; one row is the input of the loop."""
        traces = _trusted(traces)
        if not traces.index.size:
            return
        displacement_um, error_um = traces.values[ROW["displacement"]], traces.values[ROW["error"]]
        if self._folding is not None:
            loop = np.array((traces.values[loop_input], displacement_um))
            self._folding.add(traces.index - self._origin, loop)
        error_um = error_um[np.isfinite(error_um)]
        self._errors += error_um.size
        self._squares_um2 += float(np.square(error_um).sum())
        self._peak_um = max(self._peak_um, float(np.abs(error_um).max(initial=0.0)))
        self._low_um = min(self._low_um, float(np.nanmin(displacement_um, initial=math.inf)))
        self._high_um = max(self._high_um, float(np.nanmax(displacement_um, initial=-math.inf)))
        self._index = np.concatenate((self._index, traces.index))[-_NOISE_SAMPLES:]
        newest_um = np.concatenate((self._displacement_um, displacement_um))
        self._displacement_um = newest_um[-_NOISE_SAMPLES:]

    def figures(self) -> FigureValues:
        """Return the metrics; none without a displacement."""
        if not math.isfinite(self._low_um):
            return {}
        noise_um = sensor_noise_um(self._index, self._displacement_um)
        found: FigureValues = {
            "peak_to_peak_um": self._high_um - self._low_um,
            "sensor_noise_um": noise_um,
        }
        if self._errors:
            found["peak_error_um"] = self._peak_um
            found["rms_error_um"] = math.sqrt(self._squares_um2 / self._errors)
        if self._folding is not None:
            found |= self._of_cycle(self._folding, noise_um)
        return found

    def _of_cycle(self, folding: CycleAverager, noise_um: float | None) -> FigureValues:
        """Return the metrics of the mean cycle."""
        cycle = folding.fold()
        if not cycle.whole:
            return {}
        loop_input, output = cycle.signals
        stroke_um = peak_to_peak(output)
        found: FigureValues = {
            "peak_hysteresis_percent": peak_hysteresis_percent(loop_input, output),
            "peak_to_peak_um": stroke_um,
        }
        if noise_um is not None:
            found["noise_floor_percent"] = noise_floor_percent(noise_um, cycle.counts, stroke_um)
        if self._errors:
            found |= _errors_percent(output - loop_input, stroke_um)
        return found


def _errors_percent(error_um: F64, stroke_um: float) -> FigureValues:
    return {
        "peak_error_percent": percent(peak(error_um), stroke_um),
        "rms_error_percent": percent(rms(error_um), stroke_um),
    }


def _trusted(traces: Traces) -> Traces:
    kept = (traces.flags & _LEFT_OUT) == 0
    return Traces(traces.index[kept], traces.values[:, kept], traces.flags[kept])
