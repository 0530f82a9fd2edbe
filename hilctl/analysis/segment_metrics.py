"""Metrics of one segment, in one pass over its samples."""

import math

import numpy as np

from hilctl.analysis.quantiles import Quantiles
from hilctl.analysis.run_metrics import SegmentReport
from hilctl.analysis.steady_state import loop_signals, trusted
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics

_UNKNOWN: tuple[float | None, float | None] = (None, None)


class _Extremes:
    """Lowest and highest value of a signal that arrives in pieces."""

    def __init__(self) -> None:
        self._low, self._high = math.inf, -math.inf

    def add(self, values: F64) -> None:
        self._low = min(self._low, float(values.min()))
        self._high = max(self._high, float(values.max()))

    @property
    def span(self) -> float:
        return self._high - self._low


class SegmentReportBuilder:
    """Builder of the metrics of a segment from its evaluated samples.

    Sums over several pieces differ from those of the whole run in their last digits; the relative
    error of the sensor noise of more than :data:`~hilctl.analysis.quantiles.MOST_EXACT` samples is
    6e-5.
    """

    def __init__(
        self, recording: Recording, segment: Segment, window: tuple[int, int, int]
    ) -> None:
        self._rate_hz = recording.sample_rate_hz
        self._compensated = recording.compensated
        self._segment = segment
        self._start, self._stop, self._cycles = window
        self._folding = cycle_metrics.CycleAverager(segment.period, 2) if self._cycles else None
        self._samples = self._steady = 0
        self._input, self._output = _Extremes(), _Extremes()
        self._averaged, self._raw = _Errors(), _Errors()
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
        signals = loop_signals(part, compensated=self._compensated)
        if self._folding:
            self._folding.add(part.index - segment.start, signals)
        else:
            self._loop(*signals)
        if self._compensated:
            self._raw.add(signals[1] - signals[0])
        if segment.period <= 0.0 or segment.period >= cycle_metrics.SHORTEST_PERIOD:
            self._noise.add(part.index, part.displacement_um)

    def cycle(self) -> cycle_metrics.MeanCycle | None:
        """Return the average cycle of the loop's input and output; None without a period."""
        return self._folding.fold() if self._folding else None

    def _loop(self, loop_input: F64, output: F64) -> None:
        """Add a loop without a period."""
        finite = np.isfinite(loop_input) & np.isfinite(output)
        if not finite.any():
            return
        self._input.add(loop_input[finite])
        self._output.add(output[finite])
        self._averaged.add(output[finite] - loop_input[finite])

    @np.errstate(over="ignore", invalid="ignore")  # of readings near the largest number
    def report(self) -> SegmentReport:
        """Return the metrics; None for those that are not available."""
        cycle = self.cycle()
        noise_um = self._noise.rms_um()
        stroke_um = wanted_um = hysteresis = area = floor = None
        errors = raw = _UNKNOWN
        if cycle is not None and cycle.whole:
            loop_input, output = cycle.signals
            stroke_um = cycle_metrics.peak_to_peak(output)
            wanted_um = cycle_metrics.peak_to_peak(loop_input)
            errors = cycle_metrics.peak_and_rms_percent(output - loop_input, wanted_um)
            if self._segment.is_loop:
                hysteresis = cycle_metrics.peak_hysteresis_percent(loop_input, output)
                area = cycle_metrics.loop_area(loop_input, output)
            if hysteresis is not None and noise_um is not None:
                floor = cycle_metrics.noise_floor_percent(noise_um, cycle.counts, stroke_um)
        elif cycle is None and self._averaged.count:
            stroke_um, wanted_um = self._output.span, self._input.span
            errors = self._averaged.percent(wanted_um)
        if not self._compensated:
            errors = _UNKNOWN
        elif wanted_um is not None:
            raw = self._raw.percent(wanted_um)
        period = self._segment.period
        return SegmentReport(
            label=self._segment.label,
            start_s=self._segment.start / self._rate_hz,
            frequency_hz=self._rate_hz / period if period > 0.0 else None,
            samples=self._samples,
            steady_cycles=self._cycles,
            steady_samples=self._steady,
            peak_to_peak_um=stroke_um,
            peak_error_percent=errors[0],
            rms_error_percent=errors[1],
            peak_error_raw_percent=raw[0],
            rms_error_raw_percent=raw[1],
            peak_hysteresis_percent=hysteresis,
            loop_area=area,
            sensor_noise_um=noise_um,
            noise_floor_percent=floor,
        )


class _Errors:
    """Peak and root mean square of finite errors, in um."""

    def __init__(self) -> None:
        self.count = 0
        self._peak_um = self._squares_um2 = 0.0

    def add(self, error_um: F64) -> None:
        finite = np.isfinite(error_um)
        known = error_um if finite.all() else error_um[finite]
        if known.size:
            self.count += known.size
            self._peak_um = max(self._peak_um, cycle_metrics.peak(known))
            self._squares_um2 += float(np.sum(np.square(known)))

    def percent(self, whole_um: float) -> tuple[float | None, float | None]:
        """Return peak and root mean square in percent; None without errors."""
        if not self.count:
            return _UNKNOWN
        errors_um = self._peak_um, math.sqrt(self._squares_um2 / self.count)
        peak, rms = (cycle_metrics.percent(each, whole_um) for each in errors_um)
        return peak, rms


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
