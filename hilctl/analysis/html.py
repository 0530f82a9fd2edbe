"""A run as one self-contained page: no scripts, nothing fetched, figures as PNG within it."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hilctl.analysis import canvas, loops, plots, table
from hilctl.analysis.figures import RunReport
from hilctl.analysis.report import worst_segment
from hilctl.base.events import Event
from hilctl.base.files import write_text
from hilctl.base.printable import printable
from hilctl.recording.data import Recording

_MOST_EVENTS = 200

_CSS = """
:root { color-scheme: light; }
body { font: 15px/1.45 system-ui, "DejaVu Sans", sans-serif; color: #1c1c1c; background: #fff;
  max-width: 1120px; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; }
h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; border-bottom: 1px solid #ddd; }
.file { color: #666; margin: 0 0 1rem; overflow-wrap: anywhere; }
.note { background: #fff4d6; border-left: 4px solid #e69f00; padding: .5rem .8rem; }
.side { display: flex; flex-wrap: wrap; gap: 0 2.5rem; align-items: flex-start; }
table { border-collapse: collapse; margin: .3rem 0; }
th, td { text-align: left; vertical-align: top; padding: .2rem .9rem .2rem 0;
  border-bottom: 1px solid #eee; }
th { font-weight: 600; white-space: nowrap; }
td { font-variant-numeric: tabular-nums; }
.numbers td:not(:first-child), .numbers th:not(:first-child) { text-align: right; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: 13px; }
summary { cursor: pointer; }
.wide { overflow-x: auto; }
"""

_HEAD = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{css}</style></head><body>"""


def write_html(recording: Recording, report: RunReport, path: Path) -> None:
    """Write the page of a run; a page of that name is replaced.

    Args:
        recording: The run.
        report: Its figures.
        path: File to write.

    Raises:
        InputError: It can't be written.
    """
    write_page(page(recording, report), path)


def write_page(text: str, path: Path) -> None:
    """Write a page; one of that name is replaced.

    Raises:
        InputError: It can't be written.
    """
    write_text(path, text, overwrite=True)


@np.errstate(over="ignore", invalid="ignore")  # of readings near the end of all numbers
def page(recording: Recording, report: RunReport) -> str:
    """Return the page of a run as HTML."""
    title = _text(report.name or "run")
    body = [
        f"<h1>{title}</h1>",
        f'<p class="file">{_text(report.path)}</p>',
        *_notes(report),
        '<div class="side">',
        _rows("Figures", table.quality_rows(report)),
        _rows("Run", table.run_rows(report)),
        "</div>",
        *_segments(report),
        *_figures(recording, report),
        *_events(recording.events),
        *_details("Experiment", recording.experiment_yaml),
        *_details("Model", recording.model_yaml),
    ]
    return document(title, body)


def document(title: str, body: Iterable[str]) -> str:
    """Return a whole page; title and body are HTML."""
    return "\n".join((_HEAD.format(title=title, css=_CSS), *body, "</body></html>\n"))


def _text(text: str, *, lines: bool = False) -> str:
    """Return a text, perhaps from a file, as HTML that shows it."""
    return html.escape(printable(text, lines=lines))


def _notes(report: RunReport) -> list[str]:
    notes = []
    if report.simulated:
        notes.append(f"The device is {table.SIMULATED}.")
    if not report.complete:
        notes.append(f"The run is not complete: {report.reason}.")
    return [f'<p class="note">{_text(note)}</p>' for note in notes]


def _rows(heading: str, rows: Sequence[tuple[str, str]]) -> str:
    cells = "\n".join(
        f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    return f"<section><h2>{heading}</h2><table>{cells}</table></section>"


def grid(headings: Iterable[str], rows: Iterable[Iterable[str]], css: str = "") -> str:
    """Return a table of plain texts."""
    head = "".join(f"<th>{_text(heading)}</th>" for heading in headings)
    body = "\n".join(
        f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f'<div class="wide"><table class="{css}"><tr>{head}</tr>\n{body}</table></div>'


def _segments(report: RunReport) -> list[str]:
    if len(report.segments) < 2:
        return []
    note = "<p>The figures above are the worst of these.</p>"
    headings, rows = table.segment_table(report)
    return ["<h2>By segment</h2>", note, grid(headings, rows, "numbers")]


def _figures(recording: Recording, report: RunReport) -> list[str]:
    focus = worst_segment(report.segments)
    no_error = "No error is drawn: no sample has a reference displacement."
    drawn: list[tuple[str, Figure | None, str]] = [
        ("History", plots.time_history(recording, focus), "No samples were recorded."),
        ("Hysteresis", loops.hysteresis_loop(recording, focus), "No steady samples were recorded."),
        ("Error", plots.error(recording, focus), no_error),
        ("Timing", plots.lateness(recording), "No ticks were recorded."),
    ]
    parts = []
    for heading, figure, otherwise in drawn:
        parts.append(f"<h2>{heading}</h2>")
        parts.append(f"<p>{otherwise}</p>" if figure is None else image(heading, figure))
    return parts


def image(alternative: str, figure: Figure) -> str:
    """Return a figure as a PNG within the page."""
    data = base64.b64encode(canvas.png(figure)).decode("ascii")
    return f'<img alt="{alternative}" src="data:image/png;base64,{data}">'


def _events(events: Sequence[Event]) -> list[str]:
    if not events:
        return []
    rows = [(str(e.sample), e.level, e.code, e.text) for e in events[-_MOST_EVENTS:]]
    left_out = len(events) - len(rows)
    note = [f"<p>The first {left_out} are left out.</p>"] if left_out else []
    return ["<h2>Events</h2>", *note, grid(("sample", "level", "code", "text"), rows)]


def _details(heading: str, text: str) -> list[str]:
    if not text:
        return []
    return [f"<details><summary>{heading}</summary><pre>{_text(text, lines=True)}</pre></details>"]
