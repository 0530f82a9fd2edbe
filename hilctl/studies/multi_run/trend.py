"""Trends of metrics against varied parameters, and the headline of many runs."""

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilctl.base.formatting import quantity, significant, unit_text
from hilctl.base.types import F64
from hilctl.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.studies.multi_run.varied_parameter import VariedParameter, rank_of, texts_of

_SPREAD = 0.02  # of the mean: less is no change
_FEWEST = 3


@dataclass(frozen=True, slots=True)
class RunFigure:
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


def _column(name: str, text: str, unit: str, short: str) -> RunFigure:
    return RunFigure(name, text, unit, short, lambda run: getattr(run.figures, name))


STROKE = _column("peak_to_peak_um", "peak-to-peak", "um", "p-p µm")
AREA = _column("loop_area", "loop area", "um*A", "area")
HYSTERESIS = _column("peak_hysteresis_percent", "peak hysteresis", "%", "hyst. %")
PEAK_ERROR = _column("peak_error_percent", "peak error", "%", "error %")
RMS_ERROR = _column("rms_error_percent", "rms error", "%", "rms %")
MINOR_HIGH = _column("minor_high_percent", "hysteresis of upper minor loop", "%", "upper %")
MINOR_LOW = _column("minor_low_percent", "hysteresis of lower minor loop", "%", "lower %")
NATURAL = _column("natural_hz", "natural frequency", "Hz", "reson. Hz")
DAMPING = _column("damping_ratio", "damping ratio", "", "damping")
MODEL_ERROR = RunFigure(
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


def axis_name(series: RunSeries, figure: RunFigure) -> str:
    """Return the name of a metric with its unit; the unit of areas depends on the runs."""
    unit = unit_text(figure.unit)
    if figure is AREA:
        units = {digest.command_unit for _, digest in series.measured}
        unit = f"µm·{units.pop()}" if len(units) == 1 else ""
    return f"{figure.text}, {unit}" if unit else figure.text


ASYMMETRY = RunFigure("asymmetry_percent", "asymmetry", "%", "asym. %", _asymmetry)
"""Difference of the two peaks, of the peak-to-peak."""


@dataclass(frozen=True, slots=True)
class Trend:
    """A metric against one varied parameter, with the others constant."""

    figure: RunFigure
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
    figure: RunFigure,
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
    figure: RunFigure,
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


def extremes(
    figure: RunFigure, runs: Sequence[SeriesRun]
) -> tuple[tuple[SeriesRun, float], tuple[SeriesRun, float]] | None:
    """Return the runs with the lowest and the highest value of a metric; None without any."""
    found = figure.of(runs)
    if not found:
        return None
    return min(found, key=lambda each: each[1]), max(found, key=lambda each: each[1])


_MOST_FAILED = 3
_LINEAR = 0.95  # least r2 of a linear trend


def headline(series: RunSeries) -> list[str]:
    """Return sentences on the number of runs, best and worst results, trends and drift."""
    drift = str(series.drift) if series.drift else ""
    sentences = [_counted(series), *_results(series), *_trends(series)]
    return [*sentences, f"{drift[0].upper()}{drift[1:]}."] if drift else sentences


def _counted(series: RunSeries) -> str:
    whole = len(series.runs)
    done = sum(run.completed for run in series.runs)
    if not series.failed and not series.planned:
        return f"{_runs(whole)}, all completed." if whole > 1 else f"{_runs(whole)}, completed."
    parts = [f"{done} of {_runs(whole)} completed"]
    if series.failed:
        shown = [f"{series.text(run)} ({run.result})" for run in series.failed[:_MOST_FAILED]]
        left_out = len(series.failed) - len(shown)
        more = f" and {left_out} more" if left_out else ""
        parts.append(f"{len(series.failed)} failed: {'; '.join(shown)}{more}")
    if series.planned:
        parts.append(f"{series.planned} remaining")
    return f"{', '.join(parts)}."


def _runs(count: int) -> str:
    return f"{count} run{'' if count == 1 else 's'}"


def _results(series: RunSeries) -> Iterator[str]:
    if NATURAL.of(series.done):
        yield _between(series, NATURAL, series.done)
        yield _between(series, DAMPING, series.done)
        return
    compensator = next((each for each in series.dimensions if each.is_compensator), None)
    if compensator is not None:
        yield from _compensators(series, compensator)
        return
    for figure in (PEAK_ERROR, HYSTERESIS):
        if figure.of(series.done):
            yield _between(series, figure, series.done)
    if not HYSTERESIS.of(series.done) and STROKE.of(series.done):
        yield _between(series, STROKE, series.done)


def _between(series: RunSeries, figure: RunFigure, runs: Sequence[SeriesRun]) -> str:
    found = extremes(figure, runs)
    if found is None:
        return f"No run has a {figure.text}."
    (best, low), (worst, high) = found
    name = figure.text[0].upper() + figure.text[1:]
    if best is worst:
        return f"{name} {quantity(low, figure.unit)}."
    low_text, high_text = (quantity(value, figure.unit) for value in (low, high))
    return f"{name} {low_text} ({series.text(best)}) to {high_text} ({series.text(worst)})."


def _compensators(series: RunSeries, compensator: VariedParameter) -> Iterator[str]:
    """Yield peak hysteresis without and with compensators, and where each is worst."""
    parts = []
    for value in compensator.values:
        runs = [run for run in series.done if run.values.get(compensator.key) == value]
        found = extremes(HYSTERESIS, runs)
        if found is None:
            continue
        (_, low), (worst, high) = found
        others = texts_of(
            (each for each in series.dimensions if each is not compensator), worst.values
        )
        name = "without compensator" if value == "none" else f"with {value}"
        at = f", worst at {others}" if others and len(runs) > 1 else ""
        between = f"{significant(low)} to " if significant(low) != significant(high) else ""
        parts.append(f"{name} {between}{quantity(high, '%')}{at}")
    if parts:
        yield f"Peak hysteresis {'; '.join(parts)}."


def _trends(series: RunSeries) -> Iterator[str]:
    for along in series.dimensions:
        if not along.numeric:
            continue
        said = defaultdict(list)
        for figure in (STROKE, HYSTERESIS, NATURAL):
            found = [each for each in trends(series, figure, along) if _uncompensated(series, each)]
            directions = {each.direction for each in found}
            if len(directions) == 1 and (direction := directions.pop()):
                said[direction].append(figure.text)
        parts = [f"{' and '.join(names)} {_verb(names, how)}" for how, names in said.items()]
        if parts:
            yield f"With {along.name}, {'; '.join(parts)}."
        if along.is_frequency:
            yield from _linear(series, along)


def _verb(names: Sequence[str], direction: str) -> str:
    if len(names) == 1:
        return direction
    return {"rises": "rise", "falls": "fall", "does not change": "do not change"}[direction]


def _uncompensated(series: RunSeries, trend: Trend) -> bool:
    """Return whether a trend is of runs without a compensator."""
    return not any(
        run.digest is not None and run.digest.compensated
        for run in series.done
        if all(run.values.get(key) == value for key, value in trend.held.items())
    )


def _linear(series: RunSeries, along: VariedParameter) -> Iterator[str]:
    found = [
        each.r2
        for each in trends(series, AREA, along)
        if each.r2 is not None and _uncompensated(series, each)
    ]
    if found and min(found) >= _LINEAR:
        low, high = f"{min(found):.4f}", f"{max(found):.4f}"
        between = low if low == high else f"{low} to {high}"
        yield f"The loop area is linear in {along.name} (r² {between})."
