"""Trends of metrics against varied parameters."""

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilctl.base.formatting import unit_text
from hilctl.base.types import F64
from hilctl.lab.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.lab.studies.multi_run.varied_parameter import VariedParameter, rank_of

_SPREAD = 0.02  # smaller changes, as a share of the mean, count as none
_FEWEST = 3


@dataclass(frozen=True, slots=True)
class SeriesMetric:
    """A metric to compare among runs."""

    name: str  # its column in the table
    text: str
    unit: str  # its unit; ``%`` or as in :func:`hilctl.base.formatting.quantity`
    short: str  # short heading
    value: Callable[[SeriesRun], float | None]  # returns it for a run, or None

    def of(self, runs: Sequence[SeriesRun]) -> list[tuple[SeriesRun, float]]:
        """Return the runs that have a value, each with the value."""
        found = [(run, self.value(run)) for run in runs]
        return [(run, value) for run, value in found if value is not None]


def _column(name: str, text: str, unit: str, short: str) -> SeriesMetric:
    return SeriesMetric(name, text, unit, short, lambda run: getattr(run.figures, name))


STROKE = _column("peak_to_peak_um", "peak-to-peak", "um", "p-p µm")
AREA = _column("loop_area", "loop area", "um*A", "area")
HYSTERESIS = _column("peak_hysteresis_percent", "peak hysteresis", "%", "hyst. %")
PEAK_ERROR = _column("peak_error_percent", "peak error", "%", "error %")
RMS_ERROR = _column("rms_error_percent", "rms error", "%", "rms %")
NATURAL = _column("natural_hz", "natural frequency", "Hz", "reson. Hz")
DAMPING = _column("damping_ratio", "damping ratio", "", "damping")
MODEL_ERROR = SeriesMetric(
    "model_error_percent",
    "model error",
    "%",
    "model %",
    lambda run: run.digest.model_error_percent if run.digest else None,
)


def _asymmetry(run: SeriesRun) -> float | None:
    low, high, stroke = run.figures.low_um, run.figures.high_um, run.figures.peak_to_peak_um
    if low is None or high is None or not stroke:
        return None
    return 100.0 * abs(high + low) / stroke


def axis_name(series: RunSeries, figure: SeriesMetric) -> str:
    """Return the name of a metric with its unit; the unit of areas depends on the runs."""
    unit = unit_text(figure.unit)
    if figure is AREA:
        units = {digest.command_unit for _, digest in series.measured}
        unit = f"µm·{units.pop()}" if len(units) == 1 else ""
    return f"{figure.text}, {unit}" if unit else figure.text


ASYMMETRY = SeriesMetric("asymmetry_percent", "asymmetry", "%", "asym. %", _asymmetry)
"""Difference of the two peaks, of the peak-to-peak."""


@dataclass(frozen=True, slots=True)
class Trend:
    """A metric against one varied parameter, with the others constant."""

    figure: SeriesMetric
    along: VariedParameter
    held: Mapping[str, Hashable]  # value of each other parameter, by its key
    x: F64  # float64[n], values of ``along``, ascending
    y: F64  # float64[n], the metric, averaged over repeats
    slope: float | None = None  # slope of the linear fit; None with fewer than three points
    offset: float | None = None  # offset of the linear fit
    r2: float | None = None  # coefficient of determination; None like ``slope``

    @property
    def direction(self) -> str:
        """``rises``, ``falls``, ``does not change``, or empty."""
        spread = float(np.ptp(self.y))
        if spread <= _SPREAD * float(np.mean(np.abs(self.y))):
            return "does not change"
        steps = np.diff(self.y)
        if (steps > 0.0).all():
            return "rises"
        return "falls" if (steps < 0.0).all() else ""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "figure": self.figure.name,
            "along": self.along.key,
            "held": dict(self.held),
            "x": self.x.tolist(),
            "y": self.y.tolist(),
            "slope": self.slope,
            "offset": self.offset,
            "r2": self.r2,
            "direction": self.direction,
        }


def trends(
    series: RunSeries,
    figure: SeriesMetric,
    along: VariedParameter,
    runs: Sequence[SeriesRun] | None = None,
) -> list[Trend]:
    """Return a metric's trends along a parameter, one per combination of the others."""
    others = [each for each in series.dimensions if each.key != along.key]
    grouped: dict[tuple[Hashable, ...], dict[float, list[float]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for run, value in figure.of(series.done if runs is None else runs):
        at = run.values.get(along.key)
        if isinstance(at, int | float):
            held = tuple(run.values.get(each.key) for each in others)
            grouped[held][float(at)].append(value)
    found = [
        _trend(figure, along, {e.key: v for e, v in zip(others, held, strict=True)}, points)
        for held, points in grouped.items()
        if len(points) > 1
    ]
    return sorted(found, key=lambda trend: rank_of(others, trend.held))


def _trend(
    figure: SeriesMetric,
    along: VariedParameter,
    held: Mapping[str, Hashable],
    points: Mapping[float, list[float]],
) -> Trend:
    x = np.array(sorted(points))
    y = np.array([np.mean(points[at]) for at in x.tolist()])
    if x.size < _FEWEST:
        return Trend(figure, along, held, x, y)
    slope, offset = (float(each) for each in np.polyfit(x, y, 1))
    whole = float(np.sum((y - y.mean()) ** 2))
    left = float(np.sum((y - slope * x - offset) ** 2))
    return Trend(figure, along, held, x, y, slope, offset, 1.0 - left / whole if whole else None)
