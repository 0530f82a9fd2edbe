"""What came out of many runs, in a line or two: results and trends, best and worst, failures."""

from collections import defaultdict
from collections.abc import Iterator, Sequence

from hilctl.base.formatting import quantity, significant
from hilctl.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.studies.multi_run.trend import (
    AREA,
    DAMPING,
    HYSTERESIS,
    NATURAL,
    PEAK_ERROR,
    STROKE,
    RunFigure,
    Trend,
    extremes,
    trends,
)
from hilctl.studies.multi_run.varied_parameter import VariedParameter

_MOST_FAILED = 3
_LINEAR = 0.95  # least r2 of what is called linear


def headline(series: RunSeries) -> list[str]:
    """Return sentences: how many runs, what came out with best and worst, and trends."""
    return [_counted(series), *_results(series), *_trends(series), *_drift(series)]


def _counted(series: RunSeries) -> str:
    whole = len(series.runs)
    done = sum(run.completed for run in series.runs)
    if not series.failed and not series.planned:
        return f"{_runs(whole)}, all completed." if whole > 1 else f"{_runs(whole)}, completed."
    parts = [f"{done} of {_runs(whole)} completed"]
    if series.failed:
        shown = "; ".join(
            f"{series.text(run)} ({run.result})" for run in series.failed[:_MOST_FAILED]
        )
        more = len(series.failed) - _MOST_FAILED
        parts.append(
            f"{len(series.failed)} failed: {shown}" + (f" and {more} more" if more > 0 else "")
        )
    if series.planned:
        parts.append(f"{series.planned} still to come")
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
    """Say peak hysteresis before and after, with the worst place of each."""
    parts = []
    for value in compensator.values:
        runs = [run for run in series.done if run.values.get(compensator.key) == value]
        found = extremes(HYSTERESIS, runs)
        if found is None:
            continue
        (_, low), (worst, high) = found
        others = ", ".join(
            each.text(worst.values[each.key])
            for each in series.dimensions
            if each is not compensator and worst.values.get(each.key) is not None
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
            text = "; ".join(parts)
            yield f"With {along.name}, {text}."
        if along.is_frequency:
            yield from _linear(series, along)


def _verb(names: Sequence[str], direction: str) -> str:
    if len(names) == 1:
        return direction
    return {"rises": "rise", "falls": "fall", "does not change": "do not change"}[direction]


def _uncompensated(series: RunSeries, trend: Trend) -> bool:
    """Return whether a trend is of the actuator itself, not of what a compensator has left."""
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
        yield f"The loop's area is linear in {along.name} (r² {between})."


def _drift(series: RunSeries) -> Iterator[str]:
    if series.drift is not None:
        text = str(series.drift)
        yield f"{text[0].upper()}{text[1:]}."
