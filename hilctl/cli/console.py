"""Print tables, styled text and progress bars to a terminal."""

import io
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment

from hilctl.base.formatting import printable
from hilctl.cli.safe_streams import SafeStream
from hilctl.cli.verbosity import Verbosity


class SafeConsole(Console):
    """A console that escapes control characters in every text."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Return the segments to print; only those that move the cursor are not escaped."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield (
                segment
                if control or text.isprintable()
                else Segment(printable(text, lines=True), style)
            )


def console(*, stderr: bool = False) -> Console:
    """Return the console on standard output or error."""
    stream = sys.stderr if stderr else sys.stdout
    if stderr and Verbosity.quiet:  # progress only; errors are printed elsewhere
        stream = io.StringIO()
    return SafeConsole(
        file=stream.styled if isinstance(stream, SafeStream) else stream,
        markup=False,
        emoji=False,
        highlight=False,
    )


def print_rich(renderable: RenderableType) -> None:
    """Print a table or text."""
    console().print(renderable)


@contextmanager
def progress_bar(name: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Show a progress bar on standard error; yield its update function (fraction done, text)."""
    terminal = console(stderr=True)
    columns = (
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    hidden = quiet or not terminal.is_terminal
    # No refresh thread, because a campaign forks processes while the bar is shown.
    with Progress(
        *columns, console=terminal, disable=hidden, transient=True, auto_refresh=False
    ) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda done, text: bar.update(task, completed=done, description=text, refresh=True)
