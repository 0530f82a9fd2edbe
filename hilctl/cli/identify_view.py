"""An identified model, for people."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from hilctl.cli.console import console
from hilctl.identify.catalogue import CATALOGUE
from hilctl.identify.command import Identification
from hilctl.identify.judge import LoopError
from hilctl.identify.model_size import OrderError
from hilctl.identify.settings import setting_rows
from hilctl.identify.summary import HEADINGS, error_rows, parameter_texts, summary


def print_identification(found: Identification, output: Path | None) -> None:
    """Print errors loop by loop, parameters, and where the model went."""
    terminal = console()
    fit, held_out = found.fit, found.held_out
    if found.orders:
        terminal.print(_orders_table(found.orders))
    if held_out is not None:
        terminal.print(_errors_table(f"not fitted: {held_out.how}", held_out.judgement.errors))
    terminal.print(_errors_table(f"fitted: {fit.model.provenance.method}", fit.errors))
    rows = ", ".join(f"{name} {text}" for name, text in parameter_texts(fit))
    if rows:
        terminal.print(f"parameters: {rows}")
    for line in summary(found):
        terminal.print(line)
    if output is not None and found.verdict.grade != "not a model":
        terminal.print(f"model: {output}", soft_wrap=True)
    elif output is not None:
        terminal.print(f"{output} was not written", soft_wrap=True)


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
    terminal = console()
    terminal.print(kinds)
    terminal.print()
    terminal.print(settings)
