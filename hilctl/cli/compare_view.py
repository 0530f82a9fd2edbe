"""The comparison as a table."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich import box
from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from hilctl.comparison.compare import Comparison
from hilctl.comparison.compare import Progress as OnProgress
from hilctl.comparison.summary import headings, notes, table_rows, titles


def render(comparison: Comparison) -> RenderableType:
    """Return the table for a terminal."""
    title = f"models on {', '.join(comparison.sources)}"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for i, heading in enumerate(headings(comparison)):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for row in table_rows(comparison):
        table.add_row(*row)
    names = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, title in titles(comparison.rows):
        names.add_row(name, title)
    return Group(table, names, *notes(comparison))


@contextmanager
def shown_progress(*, quiet: bool) -> Iterator[OnProgress]:
    """Show a bar on standard error; yield what to call with what is done, from 0 to 1."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    hidden = quiet or not console.is_terminal
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task("compare", total=1.0)
        yield lambda done, text: bar.update(task, completed=done, description=text)
