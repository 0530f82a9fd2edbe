"""What was found, for people."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hilctl.identify.command import Finding
from hilctl.identify.fit import LoopError
from hilctl.identify.model_size import OrderError
from hilctl.identify.summary import HEADINGS, error_rows, parameter_texts, summary


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
