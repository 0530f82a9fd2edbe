"""An identified model, for people."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hilctl.identify.catalogue import CATALOGUE
from hilctl.identify.command import Identification
from hilctl.identify.judge import LoopError
from hilctl.identify.model_size import OrderError
from hilctl.identify.settings import setting_rows
from hilctl.identify.summary import HEADINGS, error_rows, parameter_texts, summary


def print_identification(found: Identification, output: Path | None) -> None:
    """Print errors loop by loop, parameters, and where the model went."""
    console = Console()
    fit, held_out = found.fit, found.held_out
    if found.orders:
        console.print(_orders_table(found.orders))
    console.print(_errors_table(fit.model.provenance.method, fit.errors))
    if held_out is not None:
        console.print(_errors_table("not fitted, to check the model", held_out.errors))
    rows = ", ".join(f"{name} {text}" for name, text in parameter_texts(fit))
    if rows:
        console.print(f"parameters: {rows}", highlight=False)
    for line in summary(found):
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


def print_settings() -> None:
    """Print every kind of model, and every setting of a fit."""
    kinds = Table("--model", "what it is", "identified by", "from", box=None)
    kinds.columns[0].no_wrap = True
    for kind, known in CATALOGUE.items():
        kinds.add_row(kind, known.title, known.found_by, known.data)
    settings = Table("--set", "default", "limits", "of", "what it is", box=None)
    settings.columns[0].no_wrap = True
    for row in setting_rows():
        settings.add_row(*row)
    console = Console()
    console.print(kinds)
    console.print()
    console.print(settings)
