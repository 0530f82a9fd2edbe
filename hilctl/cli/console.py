"""Results of studies for people, in a terminal."""

from pathlib import Path

from rich.console import Console, RenderableType

from hilctl.analysis.replay import ReplayResult


def print_rich(renderable: RenderableType) -> None:
    """Print a table or text."""
    Console().print(renderable)


def print_replay(result: ReplayResult, *, other: Path | None) -> None:
    """Print how recomputed commands compare with the recorded ones."""
    console = Console()
    unit = result.command_unit
    if result.left_out_samples:
        console.print(f"{result.left_out_samples} samples behind lost ones can't be replayed")
    if other is None and result.identical:
        console.print(f"[green]identical[/]: {result.samples} commands, bit for bit")
        return
    if other is None:
        console.print(
            f"[red]different[/]: {result.differing_samples} of {result.samples} commands, "
            f"the first at sample {result.first_difference}"
        )
    else:
        console.print(
            f"with {other} the command would have run from {result.command_min:.4g} to "
            f"{result.command_max:.4g} {unit}, {result.limited_samples} samples limited"
        )
    console.print(
        f"largest difference {result.largest_difference:.4g} {unit}, "
        f"rms {result.rms_difference:.4g} {unit}"
    )
