"""Commands on this computer and its devices: doctor, devices."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from hilctl import api
from hilctl.cli.console import listing, print_rich, progress_bar
from hilctl.cli.options import AsJson, ExperimentFile, Settings, device_names
from hilctl.cli.output import print_result
from hilctl.experiment.devices import (
    DeviceDescription,
    describe,
    inventory,
    profile_summaries,
)
from hilctl.machine.diagnosis import DEFAULT_RATE_HZ, Diagnosis, diagnose, lateness_counts
from hilctl.machine.rt_setup import Realtime
from hilctl.machine.timer_latency import Latency
from hilctl.run.probe import Probed
from hilctl.run.probe import probe as read_devices
from hilctl.run.run_folder import require_linux

devices_ = typer.Typer(rich_markup_mode=None)

_COLOURS = {
    **dict.fromkeys(("ok", "done"), "green"),
    **dict.fromkeys(("warn", "not asked"), "yellow"),
    **dict.fromkeys(("bad", "refused"), "red"),
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
    with progress_bar("measuring", quiet=as_json) as show:
        diagnosis = diagnose(
            rate or rate_hz, settings, folder, seconds,
            lambda elapsed_s: show(elapsed_s / seconds, "measuring"),
        )  # fmt: skip
    values = diagnosis.to_mapping()
    print_result(values, lambda: print_rich(render_diagnosis(diagnosis)), as_json=as_json)
    if not diagnosis.latency.kept:
        raise typer.Exit(1)


@devices_.callback(invoke_without_command=True)
def devices(context: typer.Context, as_json: AsJson = False) -> None:
    """List devices, shipped profiles and serial ports (opens none)."""
    if context.invoked_subcommand is None:
        list_(as_json=as_json)


@devices_.command("list", hidden=True)
def list_(as_json: AsJson = False) -> None:
    """List devices, shipped profiles and serial ports (opens none)."""
    listed = inventory()
    print_result(listed, lambda: print_inventory(listed), as_json=as_json)


@devices_.command()
def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Device, shipped profile, or path of a profile.",
            autocompletion=device_names,
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Show the options of a device, or the content of a profile."""
    described = describe(name)
    print_result(asdict(described), lambda: print_described(described), as_json=as_json)


@devices_.command()
def probe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Read an experiment's devices and check their answers (nothing moves)."""
    require_linux()
    axes = read_devices(experiment, settings or [])
    values = {name: asdict(probed) for name, probed in axes.items()}

    def show() -> None:
        for name, probed in axes.items():
            print(f"{name}: " if name else "", end="")
            print_probed(probed)

    print_result(values.get("", {"axes": values}), show, as_json=as_json)
    if any(probed.faults for probed in axes.values()):
        raise typer.Exit(3)


def render_diagnosis(diagnosis: Diagnosis) -> RenderableType:
    """Return findings, set-up, lateness and verdict."""
    latency = diagnosis.latency
    findings = [_row(each.name, each.level, each.text, each.remedy) for each in diagnosis.findings]
    steps = [_row(each.name, each.outcome, each.detail, each.remedy) for each in latency.steps]
    colour = "green" if latency.kept else "red"
    return Group(
        listing("this computer", findings, 2),
        listing("real-time set-up of the loop process", steps, 2),
        _lateness(latency),
        Text(diagnosis.verdict, style=f"bold {colour}"),
    )


def _row(name: str, level: str, text: str, remedy: str) -> tuple[str, Text, Text]:
    cell = Text(text)
    if remedy:
        cell.append(f"\n-> {remedy}", style="dim")
    return name, Text(level, style=_COLOURS[level]), cell


def _lateness(latency: Latency) -> RenderableType:
    counts = lateness_counts(latency.late_ns)
    longest = math.log1p(max(counts.values(), default=1))
    seconds = latency.late_ns.size / latency.rate_hz
    rows = [
        (f"from {edge_us} us", str(count), "#" * round(_BAR * math.log1p(count) / longest))
        for edge_us, count in counts.items()
    ]
    line = ", ".join(f"{name} {value:.1f}" for name, value in latency.percentiles_us().items())
    title = f"wake-up lateness, {latency.rate_hz:g} Hz, {seconds:.3g} s"
    return Group(listing(title, rows), Text(f"{line} us"))


def print_inventory(listed: Mapping[str, Any]) -> None:
    """Print devices, profiles and serial ports."""
    ports = [(port["path"], port["description"]) for port in listed["serial_ports"]]
    print_rich(
        listing("devices", sorted(listed["devices"].items())),
        listing("profiles", profile_summaries()),
        listing("serial ports", ports) if ports else Text("no serial port found"),
    )


def print_described(described: DeviceDescription) -> None:
    """Print the options of a device, or the content of a profile."""
    print(": ".join(dict.fromkeys((described.name, described.place))))
    if described.options:
        rows = [
            (each.name, "required" if each.default is None else each.default, each.description)
            for each in described.options
        ]
        print_rich(listing("", [("key", "default", "meaning"), *rows]))
    profile = described.profile
    for key in ("vendor", "model", "verified", "unverified", "max_rate_hz"):
        if key in profile:
            print(f"{key}: {_plain(profile[key])}")
    if link := profile.get("link"):
        known = [f"{key} {link[key]}" for key in ("kind", "baud", "port") if key in link]
        print(f"link: {', '.join(known)}")
    for key in ("outputs", "inputs"):
        if profile.get(key):
            print_rich(listing(key, map(_channel, profile[key].items())))
    for key in ("source", "notes"):
        texts = profile.get(key, [])
        for text in [texts] if isinstance(texts, str) else texts:
            print(f"{key}: {_plain(text)}")


def _channel(item: tuple[str, Mapping[str, object]]) -> tuple[str, str]:
    name, channel = item
    low, high, unit = (channel.get(key, "?") for key in ("min", "max", "unit"))
    return name, f"{low} to {high} {unit}"


def _plain(value: object) -> str:
    """Return a value of a file as one line."""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return " ".join(str(value).split())


def print_probed(probed: Probed) -> None:
    """Print a device's description, reading and output, and the faults found."""
    print(f"{probed.name} answers: {probed.description}")
    note = f": {probed.rate_note}" if probed.rate_note else ""
    print(f"maximum rate: {probed.max_rate_hz:.6g} samples per second{note}")
    if probed.safe_note:
        print(f"safe value: {probed.safe_note}")
    if probed.displacement_um is not None:
        print(f"displacement: {probed.displacement_um:.6g} µm")
    output = probed.output
    print(f"output: {'unknown' if output is None else f'{output:.6g} {probed.command_unit}'}")
    if probed.tripped:
        print("watchdog: tripped; 'hilctl safe' sets the safe value and clears the trip")
    if probed.measured is not None:
        print(f"measured output: {probed.measured:.6g} {probed.command_unit}")
    for key, value in probed.details.items():
        print(f"  {key}: {value}")
    for fault in probed.faults:
        print(f"fault: {fault}")
