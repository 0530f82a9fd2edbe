"""Metrics of one segment from its steady samples, in one pass."""

import math

import numpy as np

from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.signals.cycle_metrics import (
    CycleAverager,
    MeanCycle,
    loop_area,
    noise_floor_percent,
    peak_and_rms_percent,
    peak_hysteresis_percent,
    peak_to_peak,
    percent,
)


class SegmentMetrics:
    """Metrics of a segment: of its average cycle, or of all samples without a period.

    Sums over several pieces differ from those of the whole run in their last digits.

    Args:
        averaged: Whether the samples have at least one whole cycle to average.
        compensated: Whether the loop's input is a reference, so that there is an error.
    """

    def __init__(self, segment: Segment, *, averaged: bool, compensated: bool) -> None:
        self._segment, self._compensated = segment, compensated
        self._folding = CycleAverager(segment.period, 2) if averaged else None
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)  # input, displacement
        self._peak_um = self._squares_um2 = 0.0
        self._count = 0

    @np.errstate(over="ignore", invalid="ignore")  # of readings near the largest number
    def add(self, index: I64, signals: F64) -> None:
        """Add samples, int64[n], with the loop's input and displacement, float64[2, n]."""
        if self._folding:
            self._folding.add(index - self._segment.start, signals)
        finite = np.isfinite(signals).all(axis=0)
        signals = signals if finite.all() else signals[:, finite]
        if signals.size:
            error_um = signals[1] - signals[0]
            self._low = np.minimum(self._low, signals.min(axis=1))
            self._high = np.maximum(self._high, signals.max(axis=1))
            self._peak_um = max(self._peak_um, float(np.abs(error_um).max()))
            self._squares_um2 += float(np.square(error_um).sum())
            self._count += error_um.size

    def cycle(self) -> MeanCycle | None:
        """Return the average cycle of the loop's input and displacement; None without a period."""
        return self._folding.fold() if self._folding else None

    def raw(self) -> dict[str, float]:
        """Return peak-to-peak and errors of the single samples, in um; empty without any."""
        if not self._count:
            return {}
        found = {"peak_to_peak_um": float(self._high[1] - self._low[1])}
        if self._compensated:
            found["peak_error_um"] = self._peak_um
            found["rms_error_um"] = math.sqrt(self._squares_um2 / self._count)
        return found

    @np.errstate(over="ignore", invalid="ignore")
    def metrics(self, noise_um: float | None = None) -> dict[str, float]:
        """Return the available metrics by name."""
        cycle, raw = self.cycle(), self.raw()
        found: dict[str, float | None] = {}
        if cycle is not None and cycle.whole:
            loop_input, output = cycle.signals
            stroke_um, wanted_um = peak_to_peak(output), peak_to_peak(loop_input)
            errors = peak_and_rms_percent(output - loop_input, wanted_um)
            if self._segment.is_loop:
                found["peak_hysteresis_percent"] = peak_hysteresis_percent(loop_input, output)
                found["loop_area"] = loop_area(loop_input, output)
            if found.get("peak_hysteresis_percent") is not None and noise_um is not None:
                floor = noise_floor_percent(noise_um, cycle.counts, stroke_um)
                found["noise_floor_percent"] = floor
        elif cycle is None and raw:
            stroke_um, wanted_um = raw["peak_to_peak_um"], float(self._high[0] - self._low[0])
            errors = _percents(raw, wanted_um)
        else:
            return {}
        found["peak_to_peak_um"] = stroke_um
        if self._compensated:
            found["peak_error_percent"], found["rms_error_percent"] = errors
            raw_errors = _percents(raw, wanted_um)
            found["peak_error_raw_percent"], found["rms_error_raw_percent"] = raw_errors
        return {name: value for name, value in found.items() if value is not None}


def _percents(raw: dict[str, float], whole_um: float) -> tuple[float | None, float | None]:
    """Return peak and rms error in percent; None without errors or motion."""
    peak, rms = (percent(raw.get(f"{name}_error_um", 0.0), whole_um) for name in ("peak", "rms"))
    return peak, rms
