"""This machine for people, in a terminal: its diagnosis, and the devices at it."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hilctl.cli.console import console
from hilctl.experiment.inventory import Inventory
from hilctl.machine.diagnosis import Diagnosis, lateness_counts
from hilctl.machine.latency import Latency
from hilctl.machine.realtime import SetUpStep

_COLOURS = {
    "ok": "green",
    "done": "green",
    "warn": "yellow",
    "not asked": "yellow",
    "bad": "red",
    "refused": "red",
}
_BAR = 40


def render(diagnosis: Diagnosis) -> RenderableType:
    """Return findings, set-up, lateness and verdict."""
    latency = diagnosis.latency
    findings = _table("this machine")
    for each in diagnosis.findings:
        _add(findings, each.name, each.level, each.text, each.remedy)
    colour = "green" if latency.kept else "red"
    return Group(
        findings,
        _steps(latency.steps),
        _lateness(latency),
        Text(diagnosis.verdict, style=f"bold {colour}"),
    )


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for no_wrap in (True, True, False):
        table.add_column(no_wrap=no_wrap)
    return table


def _add(table: Table, name: str, level: str, text: str, remedy: str) -> None:
    said = Text(text)
    if remedy:
        said.append(f"\n-> {remedy}", style="dim")
    table.add_row(name, Text(level, style=_COLOURS[level]), said)


def _steps(steps: tuple[SetUpStep, ...]) -> Table:
    table = _table("set-up of the loop's process")
    for step in steps:
        _add(table, step.name, step.outcome, step.detail, step.remedy)
    return table


def _lateness(latency: Latency) -> RenderableType:
    counts = lateness_counts(latency.late_ns)
    longest = math.log1p(max(counts.values(), default=1))
    seconds = latency.late_ns.size / latency.rate_hz
    table = Table(
        title=f"wake-up lateness, {latency.rate_hz:g} Hz, {seconds:.3g} s",
        title_justify="left",
        show_header=False,
        box=None,
    )
    for edge_us, count in counts.items():
        bar = "#" * round(_BAR * math.log1p(count) / longest)
        table.add_row(Text(f"from {edge_us} us", justify="right"), str(count), bar)
    figures = latency.percentiles_us()
    line = ", ".join(f"{name} {value:.1f}" for name, value in figures.items())
    return Group(table, Text(f"{line} us"))


@contextmanager
def measuring(seconds: float, *, quiet: bool) -> Iterator[Callable[[float], None]]:
    """Show a bar on standard error; yield what to call with the time that has passed, in s."""
    terminal = console(stderr=True)
    with Progress(
        TextColumn("[bold]measuring"),
        BarColumn(bar_width=24),
        TimeRemainingColumn(),
        console=terminal,
        disable=quiet or not terminal.is_terminal,
        transient=True,
    ) as progress:
        task = progress.add_task("measuring", total=seconds)
        yield lambda elapsed_s: progress.update(task, completed=min(elapsed_s, seconds))


def print_inventory(found: Inventory) -> None:
    """Print devices, profiles and serial ports."""
    table = Table(title="devices", title_justify="left", show_header=False, box=None)
    for kind, place in sorted(found.devices.items()):
        table.add_row(kind, place)
    profiles = Table(title="profiles", title_justify="left", show_header=False, box=None)
    for name in found.profiles:
        profiles.add_row(name)
    ports = Table(title="serial ports", title_justify="left", show_header=False, box=None)
    for port in found.serial_ports:
        ports.add_row(port.path, port.description)
    terminal = console()
    terminal.print(table, profiles)
    terminal.print(ports if found.serial_ports else "no serial port found", soft_wrap=True)
