"""What was found, for people."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hilctl.finding.finding import Finding
from hilctl.identify.fit import Fit, LoopError
from hilctl.identify.orders import OrderError

HEADINGS = ("loop", "p-p um", "peak %", "rms %", "area %")


def error_rows(errors: Sequence[LoopError]) -> list[tuple[str, ...]]:
    """Return one row a loop under :data:`HEADINGS`."""
    rows = []
    for error in errors:
        area = "-" if error.area_error_percent is None else f"{error.area_error_percent:+.2f}"
        figures = (error.peak_to_peak_um, error.peak_percent, error.rms_percent)
        rows.append((error.label, *(f"{figure:.3g}" for figure in figures), area))
    return rows


def parameter_texts(fit: Fit) -> list[tuple[str, str]]:
    """Return names and values, with standard errors where there are any."""
    sure = fit.standard_errors
    return [
        (name, f"{value:.6g}" + (f" ± {sure[name]:.2g}" if name in sure else ""))
        for name, value in fit.parameters.items()
    ]


def summary(finding: Finding) -> list[str]:
    """Return the result in a few lines."""
    fit, held_out = finding.fit, finding.held_out
    spread = [start.rms_percent for start in fit.starts]
    lines = [
        f"{len(spread)} starts ended at rms {min(spread):.3f} to {max(spread):.3f} %, "
        f"in {fit.elapsed_s:.2f} s",
        f"peak error {fit.peak_percent:.2f} %, rms {fit.rms_percent:.2f} % of the largest "
        f"peak-to-peak; {fit.own_peak_percent:.2f} % of a loop's own",
    ]
    if held_out is not None:
        lines.append(
            f"not fitted: peak error {held_out.peak_percent:.2f} %, "
            f"rms {held_out.rms_percent:.2f} % of the largest peak-to-peak"
        )
    if finding.lag_samples:
        lines.append(f"displacements taken {finding.lag_samples} samples later than the commands")
    return lines


def print_finding(finding: Finding, output: Path | None) -> None:
    """Print errors loop by loop, parameters, and where the model went."""
    console = Console()
    fit, held_out = finding.fit, finding.held_out
    if finding.orders:
        console.print(_orders_table(finding.orders))
    console.print(_errors_table(fit.model.provenance.method, fit.errors))
    if held_out is not None:
        console.print(_errors_table("not fitted, to check the model", held_out.errors))
    rows = ", ".join(f"{name} {text}" for name, text in parameter_texts(fit))
    console.print(f"parameters: {rows}", highlight=False)
    for line in summary(finding):
        console.print(line, highlight=False)
    if output is not None:
        console.print(f"model: {output}", soft_wrap=True, highlight=False)


def _errors_table(title: str, errors: Sequence[LoopError]) -> Table:
    table = Table(title=title)
    for name in HEADINGS:
        table.add_column(name, justify="left" if name == "loop" else "right")
    for row in error_rows(errors):
        table.add_row(*row)
    return table


def _orders_table(orders: Sequence[OrderError]) -> Table:
    table = Table(title="errors on loops held out")
    for name in ("plays", "deadbands a side", "rms %", "peak %"):
        table.add_column(name, justify="right")
    for order in orders:
        figures = (f"{order.rms_percent:.3f}", f"{order.peak_percent:.2f}")
        table.add_row(str(order.plays), str(order.deadbands_a_side), *figures)
    return table
