"""HTML page and JSON of many runs."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hilctl.base.files import write_text
from hilctl.base.formatting import finite, quantity
from hilctl.lab.pages import html
from hilctl.lab.studies.multi_run.collect import RunSeries, SeriesRun
from hilctl.lab.studies.multi_run.plots import sheets_of
from hilctl.lab.studies.multi_run.trend import (
    AREA,
    ASYMMETRY,
    DAMPING,
    HYSTERESIS,
    MODEL_ERROR,
    NATURAL,
    PEAK_ERROR,
    RMS_ERROR,
    STROKE,
    Trend,
    axis_name,
    trends,
)
from hilctl.lab.studies.multi_run.varied_parameter import plain_text, texts_of

MOST_ROWS = 1000  # most rows of the table on a page

_SHORT_COLUMNS = (STROKE, HYSTERESIS, AREA, PEAK_ERROR, NATURAL, DAMPING)
_COLUMNS = (*_SHORT_COLUMNS[:4], RMS_ERROR, MODEL_ERROR, NATURAL, DAMPING)


def write_series(series: RunSeries, path: Path) -> None:
    """Write the page atomically, replacing an existing file."""
    write_text(path, series_page(series), overwrite=True)


def series_page(series: RunSeries) -> str:
    """Return the page as HTML."""
    sheets, left_out = sheets_of(series), len(series.runs) - MOST_ROWS
    body = [
        html.paragraph(series.headline, "headline"),
        *(html.paragraph(f"Not read: {problem}", "bad") for problem in series.missing),
        *(html.paragraph(f"{series.text(run)}: {run.result}", "bad") for run in series.failed),
        *_simulated(series),
        html.figures(sheets) if sheets else html.paragraph("No figure applies to these runs."),
        *_trends(series),
        "<h2>Runs</h2>",
        html.grid(*run_table(series, MOST_ROWS)),
        html.paragraph(f"{left_out} more runs are in the campaign's table.")
        if left_out > 0
        else "",
        *_made_of(series),
        html.definitions(*_terms(series)),
    ]
    return html.document(series.name, body)


def _simulated(series: RunSeries) -> Iterator[str]:
    count = sum(run.digest is not None and run.digest.simulated for run in series.runs)
    if count:
        which = "All" if count == len(series.runs) else f"{count} of the"
        yield html.paragraph(f"{which} runs were simulated: no hardware was driven.", "note")


def run_table(
    series: RunSeries, most: int, *, short: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of a table without empty columns; a short one fits a terminal."""
    columns = _SHORT_COLUMNS if short else _COLUMNS
    figures = [each for each in columns if each.of(series.runs)]
    headings = ["run", *(each.axis for each in series.dimensions)]
    headings += [each.short if short else axis_name(series, each) for each in figures]
    last = _last(series, short=short)
    rows = [
        [
            f"{run.number}{' (reference)' if run.is_reference else ''}",
            *(plain_text(run.values.get(each.key)) for each in series.dimensions),
            *(quantity(each.value(run)) for each in figures),
            *(value(run) for value in last.values()),
        ]
        for run in series.runs[:most]
    ]
    return [*headings, *last], rows


def _last(series: RunSeries, *, short: bool) -> dict[str, Callable[[SeriesRun], str]]:
    """Return the last columns by their headings."""
    found: dict[str, Callable[[SeriesRun], str]] = {}
    if not short or series.failed or series.planned:
        found["result"] = lambda run: run.result
    if not series.is_campaign and not short:
        found["name"] = lambda run: run.digest.name if run.digest else ""
        found["waveform"] = lambda run: run.digest.waveform if run.digest else ""
        found["started (UTC)"] = _started
    if not short:
        found["recording"] = lambda run: run.recording
    return found


def _started(run: SeriesRun) -> str:
    return run.digest.started[:19].replace("T", " ") if run.digest else ""


def _trends(series: RunSeries) -> Iterator[str]:
    found = list(fitted_trends(series))
    if found:
        rows = [
            (
                trend.figure.text,
                trend.along.axis,
                texts_of(series.dimensions, trend.held),
                quantity(trend.slope),
                quantity(trend.offset),
                "-" if trend.r2 is None else f"{trend.r2:.4f}",
                trend.direction,
            )
            for trend in found
        ]
        names = ("metric", "against", "at", "slope", "offset", "r²", "direction")
        yield "<h2>Linear fits</h2>"
        yield html.grid(names, rows)


def fitted_trends(series: RunSeries) -> Iterator[Trend]:
    """Yield the trends of uncompensated loops against frequency."""
    for along in series.dimensions:
        if along.is_frequency:
            for figure in (AREA, HYSTERESIS):
                yield from trends(series, figure, along, series.plain)


def _made_of(series: RunSeries) -> Iterator[str]:
    """Yield devices, dates and labels of all runs."""
    digests = [run.digest for run in series.runs if run.digest is not None]
    if not digests:
        return
    started = sorted(_started(run) for run in series.runs if run.digest is not None)
    rows = [
        ("recorded (UTC)", f"{started[0]} to {started[-1]}"),
        ("devices", _several(digest.device for digest in digests)),
        *(
            (key, _several(str(d.labels[key]) for d in digests if key in d.labels))
            for key in dict.fromkeys(key for digest in digests for key in digest.labels)
        ),
    ]
    yield html.rows("Provenance", rows)


def _several(texts: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(texts))


def _terms(series: RunSeries) -> list[str]:
    terms = ["average cycle", "peak hysteresis", "loop area", "r²"]
    if PEAK_ERROR.of(series.done):
        terms.append("peak and rms error")
    if MODEL_ERROR.of(series.done):
        terms.append("model error")
    if ASYMMETRY.of(series.done) and any(each.name == "amplitude" for each in series.dimensions):
        terms.append("asymmetry")
    return terms


def series_mapping(series: RunSeries) -> dict[str, Any]:
    """Return plain values for JSON; numbers that are not finite become None."""
    return {
        "name": series.name,
        "headline": series.headline,
        "varied": [
            {"key": each.key, "name": each.name, "unit": each.unit, "values": list(each.values)}
            for each in series.dimensions
        ],
        "runs": [_run(run) for run in series.runs],
        "failed": [run.number for run in series.failed],
        "not_read": list(series.missing),
        "trends": [trend.to_mapping() for trend in fitted_trends(series)],
        "drift": asdict(series.drift) if series.drift else None,
    }


def _run(run: SeriesRun) -> dict[str, Any]:
    return {
        "run": run.number,
        "reference_run": run.is_reference,
        "values": dict(run.values),
        "result": run.result,
        "recording": run.recording,
        "started": run.digest.started if run.digest else None,
        "model_error_percent": run.digest.model_error_percent if run.digest else None,
        **finite(asdict(run.figures)),
    }
