"""Report of one segment, in one pass over its samples."""

import numpy as np

from hilctl.analysis.quantiles import Quantiles
from hilctl.analysis.run_metrics import SegmentReport
from hilctl.analysis.steady_state import loop_signals, trusted
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics
from hilctl.signals.segment_metrics import SegmentMetrics

_METRICS = (
    *("peak_hysteresis_percent", "noise_floor_percent", "loop_area", "peak_to_peak_um"),
    *("peak_error_percent", "rms_error_percent"),
    *("peak_error_raw_percent", "rms_error_raw_percent"),
)


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
            sensor_noise_um=noise_um,
            **{name: found.get(name) for name in _METRICS},
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
