"""Tables, styled text and progress for a terminal."""

import io
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from hilctl.base.formatting import printable
from hilctl.cli.output import SafeStream, Verbosity

_ONCE = "hilctl: compiling for this machine, only once, about 10 s:"


class SafeConsole(Console):
    """A console that escapes control characters in every text."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Return the segments to print; only those that move the cursor are not escaped."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            safe = control or text.isprintable()
            yield segment if safe else Segment(printable(text, lines=True), style)


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


def print_rich(*renderables: RenderableType) -> None:
    """Print tables or texts."""
    console().print(*renderables)


def table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    left: Collection[str] = (),
    *,
    wrap: bool = False,
) -> Table:
    """Return a table of plain texts, never markup; the first and ``left`` columns align left."""
    made = Table(title=Text(title) if title else None, title_justify="left")
    for number, heading in enumerate(headings):
        justify: JustifyMethod = "left" if number == 0 or heading in left else "right"
        no_wrap = justify == "right" and not wrap  # a number must not be cut
        made.add_column(Text(heading), justify=justify, no_wrap=no_wrap, overflow="fold")
    for row in rows:
        made.add_row(*map(Text, row))
    return made


def listing(title: str, rows: Iterable[Sequence[str | Text]], wrap_from: int = 1) -> Table:
    """Return rows in aligned columns without lines or headings; long cells wrap from a column."""
    made = Table(title=Text(title) if title else None, title_justify="left", box=None)
    made.show_header, made.padding = False, (0, 2, 0, 0)
    for row in rows:
        while len(made.columns) < len(row):
            made.add_column(no_wrap=len(made.columns) < wrap_from, overflow="fold")
        made.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return made


@contextmanager
def progress_bar(name: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Show a progress bar on standard error; yield its update function (fraction done, text)."""
    terminal = console(stderr=True)
    text = TextColumn("{task.description}", markup=False)
    with Progress(
        BarColumn(bar_width=24), TimeElapsedColumn(), text,
        console=terminal, disable=quiet or not terminal.is_terminal, transient=True,
        auto_refresh=False,  # no thread, because a campaign forks processes meanwhile
    ) as bar:  # fmt: skip
        task = bar.add_task(name, total=1.0)
        yield lambda done, text: bar.update(task, completed=done, description=text, refresh=True)


@contextmanager
def compile_progress() -> Iterator[None]:
    """Print the name of each kernel that is compiled meanwhile; only to a terminal."""
    if Verbosity.quiet or not sys.stderr.isatty():
        yield
        return
    from numba.core.event import Event, Listener, install_listener

    class Progress(Listener):
        depth = 0
        lines: tuple[str, ...] = (_ONCE,)

        def on_start(self, event: Event) -> None:
            if not self.depth:  # a kernel is compiled during the compilation of its caller
                name = event.data["dispatcher"].py_func.__name__
                print(*self.lines, f"  {name}", sep="\n", file=sys.stderr)
                self.lines = ()
            self.depth += 1

        def on_end(self, event: Event) -> None:
            self.depth -= 1

    with install_listener("numba:compile", Progress()):
        yield
