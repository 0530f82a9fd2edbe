"""A bar of progress on standard error."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


@contextmanager
def shown_progress(name: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Show a bar on standard error; yield what to call with what is done, from 0 to 1."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    hidden = quiet or not console.is_terminal
    with Progress(*columns, console=console, disable=hidden, transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda done, text: bar.update(task, completed=done, description=text)
