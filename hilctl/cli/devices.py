"""Commands on this computer and its devices: doctor, devices."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hilctl import api
from hilctl.cli.console import console, print_rich
from hilctl.cli.options import AsJson, ExperimentFile, Settings
from hilctl.cli.safe_streams import print_json
from hilctl.experiment.devices import DeviceDescription, Inventory, describe, inventory
from hilctl.machine.diagnosis import DEFAULT_RATE_HZ, Diagnosis, diagnose, lateness_counts
from hilctl.machine.rt_setup import SetUpStep
from hilctl.machine.settings import Realtime
from hilctl.machine.timer_latency import Latency
from hilctl.run.architecture import require_linux

if TYPE_CHECKING:
    from hilctl.run.probe import Probed

devices_app = typer.Typer(rich_markup_mode=None)

_COLOURS = {
    "ok": "green",
    "done": "green",
    "warn": "yellow",
    "not asked": "yellow",
    "bad": "red",
    "refused": "red",
}
_BAR = 40


def doctor(
    rate: Annotated[
        float | None,
        typer.Option(
            min=1.0, max=20e3, help="Ticks per second; default: the experiment's, or 1000."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration of the measurement, s.")] = 10.0,
    experiment: Annotated[
        Path | None, typer.Option(help="Experiment whose rate and real-time settings to use.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check this computer for real-time problems and measure whether it keeps a rate."""
    require_linux()
    settings, folder, rate_hz = Realtime(), Path("recordings"), DEFAULT_RATE_HZ
    if experiment is not None:
        config = api.load(experiment).config
        settings, folder = config.realtime, Path(config.recording.folder)
        rate_hz = 1.0 / config.tick_s
    with measurement_progress(seconds, quiet=as_json) as on_progress:
        diagnosis = diagnose(rate or rate_hz, settings, folder, seconds, on_progress)
    if as_json:
        print_json(diagnosis.to_mapping())
    else:
        print_rich(render_diagnosis(diagnosis))
    if not diagnosis.latency.kept:
        raise typer.Exit(1)


@devices_app.callback(invoke_without_command=True)
def devices(context: typer.Context, as_json: AsJson = False) -> None:
    """List devices, shipped profiles and serial ports (opens none)."""
    if context.invoked_subcommand is not None:
        return
    listed = inventory()
    if as_json:
        print_json(listed.to_mapping())
    else:
        print_inventory(listed)


@devices_app.command()
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Device or shipped profile.")],
    as_json: AsJson = False,
) -> None:
    """Show the options of a device, or the content of a profile."""
    described = describe(name)
    if as_json:
        print_json(described.to_mapping())
    else:
        print_described(described)


@devices_app.command()
def probe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Read an experiment's device and check its answers (nothing moves)."""
    require_linux()
    from hilctl.run.probe import probe as read_device  # imports numba

    probed = read_device(experiment, settings or [])
    if as_json:
        print_json(probed.to_mapping())
    else:
        print_probed(probed)
    if probed.faults:
        raise typer.Exit(3)


def render_diagnosis(diagnosis: Diagnosis) -> RenderableType:
    """Return findings, set-up, lateness and verdict."""
    latency = diagnosis.latency
    findings = _table("this computer")
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
    cell = Text(text)
    if remedy:
        cell.append(f"\n-> {remedy}", style="dim")
    table.add_row(name, Text(level, style=_COLOURS[level]), cell)


def _steps(steps: tuple[SetUpStep, ...]) -> Table:
    table = _table("real-time set-up of the loop process")
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
def measurement_progress(seconds: float, *, quiet: bool) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on standard error; yield its update function (elapsed time, s)."""
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


def print_inventory(listed: Inventory) -> None:
    """Print devices, profiles and serial ports."""
    table = Table(title="devices", title_justify="left", show_header=False, box=None)
    for kind, place in sorted(listed.devices.items()):
        table.add_row(kind, place)
    profiles = Table(title="profiles", title_justify="left", show_header=False, box=None)
    for name in listed.profiles:
        profiles.add_row(name)
    ports = Table(title="serial ports", title_justify="left", show_header=False, box=None)
    for port in listed.serial_ports:
        ports.add_row(port.path, port.description)
    terminal = console()
    terminal.print(table, profiles)
    terminal.print(ports if listed.serial_ports else "no serial port found", soft_wrap=True)


def print_described(described: DeviceDescription) -> None:
    """Print the options of a device, or the content of a profile."""
    terminal = console()
    terminal.print(f"{described.name}: {described.place}", soft_wrap=True, markup=False)
    if described.options:
        terminal.print(_options(described))
    profile = described.profile
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


def _options(described: DeviceDescription) -> Table:
    table = Table(box=None)
    for heading in ("key", "default", "meaning"):
        table.add_column(heading, no_wrap=heading == "key")
    for option in described.options:
        default = "required" if option.default is None else option.default
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


def print_probed(probed: "Probed") -> None:
    """Print a device's description, reading and output, and the faults found."""
    print(f"{probed.name} answers: {probed.description}")
    note = f": {probed.rate_note}" if probed.rate_note else ""
    print(f"maximum rate: {probed.max_rate_hz:.6g} samples per second{note}")
    if probed.safe_note:
        print(f"safe value: {probed.safe_note}")
    if probed.displacement_um is not None:
        print(f"displacement: {probed.displacement_um:.6g} µm")
    if probed.output is None:
        print("output: unknown")
    else:
        print(f"output: {probed.output:.6g} {probed.command_unit}")
    for key, value in probed.details.items():
        print(f"  {key}: {value}")
    for fault in probed.faults:
        print(f"fault: {fault}")
