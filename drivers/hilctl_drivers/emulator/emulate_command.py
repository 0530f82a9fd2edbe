"""The command ``hilctl emulate``: emulate a profile, or the device of an experiment."""

import gc
import shlex
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, cast

import typer

from hilctl.base.device import limited_range
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.formatting import finite_json
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Document, load_document
from hilctl_drivers.dac import SerialOptions
from hilctl_drivers.emulator.factory import Emulator, build
from hilctl_drivers.emulator.options import (
    KINDS,
    LASTING,
    EmulatorOptions,
    LinkKind,
    ReaderLine,
    RigOptions,
    parse_fault,
)
from hilctl_drivers.emulator.rig import ACTUATORS
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import NamedProfile, shipped_profiles
from hilctl_drivers.signal_chain import AddressOptions, DacOptions
from hilctl_drivers.simulated.devices import SimulatedOptions

_UNPRIVILEGED = 1024
_HERE = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True, slots=True)
class WiredExperiment:
    """An experiment whose device is to be emulated."""

    path: Path
    section: Mapping[str, Any]  # its device section, as in the file
    options: EmulatorOptions

    def words(self, emulator: Emulator) -> list[str]:
        """Return the arguments of ``hilctl`` that run it on an emulator, at any address."""
        places: dict[str, Any] = {
            key: emulator.options[key]
            for key in ("host", "tcp_port", "serial_port", "reader")
            if key in emulator.options
        }
        own, profile = self.section.get("unit_id"), emulator.device.profile
        if own is not None and isinstance(profile, ModbusProfile) and own != profile.unit_id:
            places["unit_id"] = profile.unit_id
        settings = [f"device.{key}={value}" for key, value in _differing(places, self.section)]
        return ["run", str(self.path), *(word for each in settings for word in ("--set", each))]


def is_experiment(name: str) -> bool:
    """Return whether a name belongs to an experiment file."""
    path = Path(name)
    if path.suffix not in {".yaml", ".yml"} or not path.is_file():
        return False
    return "device" in load_document(path).data


def wired_experiment(
    path: Path, port: int = 0, host: str | None = None, actuator: Sequence[str] = ()
) -> WiredExperiment:
    """Return the device of an experiment to emulate; raise InputError if it has no profile."""
    # Port 0 stands for that of the experiment, or for a free one if users may not listen there.
    document, files = load_document(path), TextFiles()
    section = document.data.get("device")
    name = section.get("profile") if isinstance(section, dict) else None
    if not isinstance(section, dict) or not isinstance(name, str):
        rule = "must name a profile: a device without one has no connection to emulate"
        raise ConfigError([document.problem("device.profile", rule)])
    # The options of a device of any protocol: those of serial_dac include all.
    context = {"folder": path.parent, "files": files}
    options: DacOptions = document.validate(
        SerialOptions, at=("device",), without=("kind",), context=context
    )
    unit = "A" if options.amplifier is None else options.amplifier.command_unit
    of_reader: dict[str, Any] = {}
    if (reader := options.reader) is not None:
        of_reader = {
            "reader": _found(reader.profile, path.parent),
            "reader_link": _link(reader),
            "reader_line": "own" if reader.host or reader.serial_port else "same",
            "reader_unit_id": reader.unit_id,
            "reader_port": _port(reader),
        }
    rig = RigOptions(
        output=options.output,
        sensor=options.input,
        actuator=_actuator(unit, actuator, document.data.get("amplifier")),
        wiring=(options.amplifier, options.sensor),
        limits=limited_range(document.data.get("limits")),
    )
    made = EmulatorOptions(
        profile=_found(options.profile, path.parent),
        link=_link(options),
        host=host or EmulatorOptions.host,
        port=port or _port(options),
        rigs=(rig,),
        **of_reader,
    )
    return WiredExperiment(path, section, made)


def _found(named: NamedProfile, folder: Path) -> str:
    """Return a profile's name, with the experiment's folder if it is a path."""
    path = Path(named.name)
    return str(folder / path) if path.suffix or len(path.parts) > 1 else named.name


def _port(options: AddressOptions) -> int:
    """Return the TCP port of options if users may listen there; otherwise 0, for a free one."""
    given = options.tcp_port or 0
    return given if options.host in _HERE and given >= _UNPRIVILEGED else 0


def _actuator(
    unit: CommandUnit, settings: Sequence[str], amplifier: Any = None
) -> SimulatedOptions:
    """Return the options of the actuator with a unit; ``amplifier`` is the experiment's section."""
    document = Document("--actuator", "{}")
    for each in settings:
        document.set(each, "--actuator")
    of_device = [
        document.problem(key, "acts on simulated devices only")
        for key in ("fault", "output_at_open")
        if document.holds((key,))
    ]
    if of_device:
        raise ConfigError(of_device)
    made = document.validate(ACTUATORS[unit].Options, context={"amplifier": amplifier})
    return cast(SimulatedOptions, made)


def _link(options: AddressOptions) -> LinkKind | None:
    """Return how to serve a device at an address; None if it shares that of the other one."""
    if options.serial_port is not None:
        return "rtu"
    if options.host is None:
        return None
    profile = options.profile.profile
    framing = options.framing or next(iter(profile.framings), "tcp")
    return "tcp" if framing == "tcp" else "rtu_tcp"


def _differing(
    places: Mapping[str, Any], section: Mapping[str, Any], above: str = ""
) -> Iterator[tuple[str, Any]]:
    for key, value in places.items():
        stands = section.get(key)
        if isinstance(value, Mapping):
            yield from _differing(value, stands if isinstance(stands, Mapping) else {}, f"{key}.")
        elif key != "profile" and value != stands and not (key == "unit_id" and stands is None):
            yield f"{above}{key}", value


def emulate(
    profile: Annotated[
        str,
        typer.Argument(
            help="Shipped profile, path of a profile, or an experiment (uses its wiring).",
            metavar="PROFILE|EXPERIMENT",
            autocompletion=lambda: list(shipped_profiles()),
        ),
    ],
    link: Annotated[
        LinkKind | None, typer.Option(help="Link of the device; default: from the profile.")
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = EmulatorOptions.host,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port; 0 for any free port.")
    ] = EmulatorOptions.port,
    log: Annotated[Path | None, typer.Option(help="Log file for every write.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND@WHEN",
            help="Fault at request KIND@COUNT or time KIND@SECONDSs; may be repeated. Kinds: "
            f"{', '.join(KINDS)}. {', '.join(LASTING)} take a duration: delay:0.3@500.",
        ),
    ] = None,
    output: Annotated[str | None, typer.Option(help="Output that drives the rig.")] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Input that reads the displacement, or READER:INPUT.")
    ] = None,
    reader: Annotated[
        str | None, typer.Option(help="Profile of the device with the input, if separate.")
    ] = None,
    reader_line: Annotated[
        ReaderLine | None,
        typer.Option(help="Line of the reader; default: same for two Modbus RTU, otherwise own."),
    ] = None,
    reader_unit_id: Annotated[int | None, typer.Option(help="Unit id of the reader.")] = None,
    reader_port: Annotated[
        int, typer.Option(min=0, max=65535, help="The reader's own TCP port; 0 for any free port.")
    ] = EmulatorOptions.reader_port,
    unit: Annotated[
        CommandUnit | None, typer.Option(help="Unit of the drive: current or voltage; default: A.")
    ] = None,
    actuator: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="Option of the simulated actuator, such as load_kg=2; may be repeated.",
        ),
    ] = None,
    command: Annotated[
        float | None,
        typer.Option(
            "--command",
            "--current-a",
            help="Initial command, A or V, for Modbus profiles; default: as after power-up.",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON when ready.")
    ] = False,
) -> None:
    """Emulate a device with the simulated rig, until Ctrl-C."""
    wired = None
    own: dict[str, Any] = {
        "link": link, "reader": reader, "reader_line": reader_line,
        "reader_unit_id": reader_unit_id,
    }  # fmt: skip
    if is_experiment(profile):
        of_rig = {"output": output, "sensor": sensor, "unit": unit}
        given = [key for key, value in (own | of_rig).items() if value is not None]
        if given:
            names = ", ".join(f"--{key.replace('_', '-')}" for key in given)
            raise InputError(f"{names}: specified by {profile} already")
        wired = wired_experiment(Path(profile), port, host, actuator or ())
        options = wired.options
    else:
        if reader is None and sensor is not None and ":" in sensor:
            own["reader"], _, sensor = sensor.rpartition(":")
        rig = RigOptions(output, sensor, _actuator(unit or "A", actuator or ()))
        options = EmulatorOptions(profile, host=host, port=port, rigs=(rig,), **own)
    faults = tuple(parse_fault(text) for text in fault or ())
    reader_port = reader_port or options.reader_port
    options = replace(options, log=log, faults=faults, command=command, reader_port=reader_port)
    serve(options, partial(_say, as_json=as_json, wired=wired))


def _say(emulator: Emulator, *, as_json: bool, wired: WiredExperiment | None) -> None:
    if as_json:
        typer.echo(finite_json(_report(emulator, wired)))
        return
    for profile, address, unit_id in emulator.places:
        unit = f", unit {unit_id}" if unit_id is not None else ""
        typer.echo(f"{profile} answers at {address}{unit}")
    for section, wired_rig in zip(emulator.sections, emulator.rigs, strict=True):
        wiring, info = wired_rig.wiring, wired_rig.rig.actuator.info
        gain, offset, um_per_unit, offset_um = wiring.factors
        unit = wiring.command_unit
        drive = {"A": "current", "V": "voltage"}[unit]
        typer.echo(f"{section['output']}: {drive} = {gain:g} {unit} x output {offset:+g} {unit}")
        shown = f"{um_per_unit:g} µm x input {offset_um:+g} µm"
        typer.echo(f"{section['input']}: displacement = {shown}")
        limits = f"{info.command_min:g} to {info.command_max:g} {unit}"
        typer.echo(f"{info.name}: {limits}, {info.sensor_min_um:g} to {info.sensor_max_um:g} µm")
    if wired is not None:
        typer.echo(f"hilctl {shlex.join(wired.words(emulator))}")


def _report(emulator: Emulator, wired: WiredExperiment | None) -> dict[str, Any]:
    wiring = emulator.rigs[0].wiring
    suffix = wiring.command_unit.lower()
    names = f"gain_{suffix}", f"offset_{suffix}", "sensor_um", "offset_um"
    terminals = {key: emulator.options[key] for key in ("output", "input")}
    report = {
        "devices": [each._asdict() for each in emulator.places],
        "wiring": terminals | dict(zip(names, wiring.factors, strict=True)),
    }
    if wired is not None:
        report["arguments"] = wired.words(emulator)
    return report


def serve(options: EmulatorOptions, on_ready: Callable[[Emulator], None]) -> None:
    """Serve an emulator until SIGINT or SIGTERM; call ``on_ready`` once its devices answer."""
    emulator = build(options)

    def stop(number: int, frame: FrameType | None) -> None:
        emulator.server.stop()

    gc.collect()
    gc.freeze()  # collecting all imported objects takes tens of ms
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        on_ready(emulator)
        emulator.server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        emulator.log.close()
