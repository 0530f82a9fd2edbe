"""A report as compact tables."""

from collections.abc import Sequence

from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl.analysis.figures import RunReport
from hilctl.analysis.table import quality_rows, run_rows, segment_table
from hilctl.base.formatting import printable

_MOST_MINUTES = 20
_COUNTS = {"minute", "ticks"}
_PAGE_ONLY = {"cycles", "start s", "freq. Hz", "floor %", "loop area"}  # a terminal has 80 columns


def render(report: RunReport) -> Group:
    """Return a report as tables for a terminal; that of the segments where there are several."""
    title = printable(report.name) or "run"
    quality = _two_columns(title, quality_rows(report))
    parts = [quality, _two_columns("", run_rows(report))]
    if len(report.segments) > 1:
        parts.append(_segments(report))
    if len(report.lateness_by_minute) > 1:
        parts.append(_minutes(report))
    return Group(*parts)


def _two_columns(title: str, rows: Sequence[tuple[str, str]]) -> Table:
    # Text, not str: names and labels come from files and must not be read as markup.
    table = Table(title=Text(title) if title else None, show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(Text(name), Text(value))
    return table


def _segments(report: RunReport) -> Table:
    table = Table(title="by segment, worst above", title_justify="left")
    headings, rows = segment_table(report)
    shown = [i for i, heading in enumerate(headings) if heading not in _PAGE_ONLY]
    for i in shown:
        table.add_column(headings[i], justify="right" if i else "left", no_wrap=True)
    for cells in rows:
        table.add_row(*(Text(cells[i]) for i in shown))
    return table


def _minutes(report: RunReport) -> Table:
    minutes = report.lateness_by_minute
    title = "lateness by minute, µs"
    if len(minutes) > _MOST_MINUTES:
        # Of a day nobody reads each; --json has them all.
        title += f": worst {_MOST_MINUTES} of {len(minutes)}"
        worst = sorted(minutes, key=lambda each: -each["max"])[:_MOST_MINUTES]
        minutes = sorted(worst, key=lambda each: each["minute"])
    table = Table(title=title, title_justify="left")
    for heading in minutes[0]:
        table.add_column(heading, justify="right", no_wrap=True)
    for minute in minutes:
        cells = (f"{v:,}" if name in _COUNTS else f"{v:.4g}" for name, v in minute.items())
        table.add_row(*cells)
    return table
