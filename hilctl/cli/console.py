"""Tables and colours in a terminal: the only console, and results of studies on it."""

import io
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from hilctl.base.formatting import printable, quantity
from hilctl.cli.streams import PlainStream
from hilctl.cli.volume import Volume

if TYPE_CHECKING:
    from hilctl.analysis.replay import ReplayResult


class PlainConsole(Console):
    """A console that takes no text for markup, and shows control characters in all it is given."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Return the segments of what is to be printed; those that move the cursor stay."""
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
    if stderr and Volume.quiet:  # bars of progress; what is wrong does not come this way
        stream = io.StringIO()
    return PlainConsole(
        file=stream.styled if isinstance(stream, PlainStream) else stream,
        markup=False,
        emoji=False,
        highlight=False,
    )


def print_rich(renderable: RenderableType) -> None:
    """Print a table or text."""
    console().print(renderable)


def print_replay(result: "ReplayResult", *, other: Path | None) -> None:
    """Print how recomputed commands compare with the recorded ones."""
    terminal = console()
    unit = result.command_unit
    if result.left_out_samples:
        terminal.print(f"{result.left_out_samples} samples behind lost ones can't be replayed")
    if other is None and result.identical:
        terminal.print(Text("identical", "green") + f": {result.samples} commands, bit for bit")
        return
    if other is None:
        terminal.print(
            Text("different", "red") + f": {result.differing_samples} of {result.samples} "
            f"commands, the first at sample {result.first_difference}"
        )
    else:
        terminal.print(
            f"with {other} the command would have run from {result.command_min:.4g} to "
            f"{result.command_max:.4g} {unit}, {result.limited_samples} samples limited"
        )
    if (error := result.predicted) is not None:
        terminal.print(
            f"error that it would have had: {quantity(error.peak_percent, '%')} peak, "
            f"{quantity(error.rms_percent, '%')} rms; recorded on the same samples: "
            f"{quantity(error.recorded_peak_percent, '%')} peak, "
            f"{quantity(error.recorded_rms_percent, '%')} rms"
        )
    terminal.print(
        f"largest difference {result.largest_difference:.4g} {unit}, "
        f"rms {result.rms_difference:.4g} {unit}"
    )
