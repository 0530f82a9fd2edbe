"""The comparison as a table."""

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

from hilctl.comparison.compare import Comparison
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
