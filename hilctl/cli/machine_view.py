"""This machine for people, in a terminal: its diagnosis, and the devices at it."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from rich.console import Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hilctl.cli.console import console
from hilctl.experiment.inventory import Described, Inventory
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


def print_described(found: Described) -> None:
    """Print a device's options, or what a profile says of its device."""
    terminal = console()
    terminal.print(f"{found.name}: {found.place}", soft_wrap=True, markup=False)
    if found.options:
        terminal.print(_options(found))
    profile = found.profile
    for key in ("vendor", "model", "verified", "unverified", "max_rate_hz"):
        if key in profile:
            terminal.print(f"{key}: {_plain(profile[key])}", markup=False)
    for key in ("outputs", "inputs"):
        if profile.get(key):
            terminal.print(_channels(key, profile[key]))
    for key in ("source", "notes"):
        texts = profile.get(key, [])
        for text in [texts] if isinstance(texts, str) else texts:
            terminal.print(f"{key}: {_plain(text)}", markup=False, soft_wrap=True)


def _options(found: Described) -> Table:
    table = Table(box=None)
    for heading in ("key", "default", "meaning"):
        table.add_column(heading, no_wrap=heading == "key")
    for option in found.options:
        default = "must be given" if option.default is None else option.default
        table.add_row(option.name, Text(default), Text(option.description))
    return table


def _channels(title: str, channels: Mapping[str, Mapping[str, object]]) -> Table:
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for name, channel in channels.items():
        low, high, unit = (channel.get(key, "?") for key in ("min", "max", "unit"))
        table.add_row(Text(name), f"{low} to {high} {unit}")
    return table


def _plain(value: object) -> str:
    """Return a value of a file as one line."""
    return (
        ", ".join(map(str, value))
        if isinstance(value, list | tuple)
        else " ".join(str(value).split())
    )
