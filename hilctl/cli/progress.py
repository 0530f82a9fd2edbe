"""A bar of progress on standard error."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from hilctl.cli.console import console


@contextmanager
def shown_progress(name: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Show a bar on standard error; yield what to call with what is done, from 0 to 1."""
    terminal = console(stderr=True)
    columns = (
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    hidden = quiet or not terminal.is_terminal
    # Without a thread that draws it: a campaign forks its runs' helpers below it.
    with Progress(
        *columns, console=terminal, disable=hidden, transient=True, auto_refresh=False
    ) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda done, text: bar.update(task, completed=done, description=text, refresh=True)
