"""A report of many runs in a terminal."""

from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl.base.formatting import printable
from hilctl.series.collect import RunSeries
from hilctl.series.headline import headline
from hilctl.series.page import MOST_ROWS, run_table


def render_series(series: RunSeries) -> Group:
    """Return what came out of many runs: in words, then a table of them."""
    headings, rows = run_table(series, MOST_ROWS, short=True)
    table = Table(title=Text(printable(series.name)), title_justify="left")
    for number, heading in enumerate(headings):
        left = number == 0 or heading == "result"
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for cells in rows:
        table.add_row(*(Text(printable(cell)) for cell in cells))
    problems = [Text(f"not read: {printable(each)}", "red") for each in series.missing]
    named = [] if series.is_campaign else [(run.number, run.recording) for run in series.runs]
    files = [Text(f"{number}: {printable(name)}") for number, name in named]
    return Group(Text(printable(" ".join(headline(series)))), *problems, table, *files)
