"""The command ``hilctl emulate``: emulate a profile, or the devices of an experiment."""

import gc
import shlex
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, cast

import typer

from hilctl.base.axes import axis_documents, names_text, of_each_axis, with_settings
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
from hilctl_drivers.profile import NamedProfile, load_profile, shipped_profiles
from hilctl_drivers.signal_chain import AddressOptions, DacOptions
from hilctl_drivers.simulated.simulated_device import SimulatedOptions

_UNPRIVILEGED = 1024
_HERE = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True, slots=True)
class WiredAxis:
    """An axis of an experiment, and where it is emulated."""

    name: str  # empty if it is the only one
    section: Mapping[str, Any]  # its device section, as in the file
    device: int
    rig: int  # of those of the device


@dataclass(frozen=True, slots=True)
class WiredExperiment:
    """An experiment whose devices are to be emulated."""

    path: Path
    settings: tuple[str, ...]
    axes: tuple[WiredAxis, ...]
    options: tuple[EmulatorOptions, ...]  # one per device

    def words(self, emulators: Sequence[Emulator]) -> list[str]:
        """Return the arguments of ``hilctl`` that run it on emulators, at any addresses."""
        found: dict[str, dict[str, Any]] = {}
        for axis in self.axes:
            emulator = emulators[axis.device]
            places: dict[str, Any] = {
                key: value
                for key, value in emulator.sections[axis.rig].items()
                if key in {"host", "tcp_port", "serial_port", "reader"}
            }
            own, profile = axis.section.get("unit_id"), emulator.device.profile
            if own is not None and isinstance(profile, ModbusProfile) and own != profile.unit_id:
                places["unit_id"] = profile.unit_id
            above = f"axes.{axis.name}.device" if axis.name else "device"
            found[above] = dict(_differing(places, axis.section))
        # A key of all axes that each axis sets would have no effect.
        replaced = {f"device.{key}" for key in set.intersection(*map(set, found.values()))}
        settings = [
            each for each in self.settings if each.partition("=")[0].strip() not in replaced
        ]
        settings += [
            f"{above}.{key}={value}" for above, each in found.items() for key, value in each.items()
        ]
        return ["run", str(self.path), *(word for each in settings for word in ("--set", each))]


def is_experiment(name: str) -> bool:
    """Return whether a name belongs to an experiment file."""
    path = Path(name)
    if path.suffix not in {".yaml", ".yml"} or not path.is_file():
        return False
    return not {"device", "axes"}.isdisjoint(load_document(path).data)


def wired_experiment(
    path: Path,
    settings: Sequence[str] = (),
    port: int = 0,
    host: str | None = None,
    actuator: Sequence[str] = (),
) -> WiredExperiment:
    """Return the devices of an experiment to emulate; raise InputError if one has no profile."""
    # Port 0 stands for that of the experiment, or for a free one if users may not listen there.
    document, files = with_settings(load_document(path), settings), TextFiles()
    names = [*axis_documents(document)]
    simulated = _by_axis(_actuator_document(actuator), names)

    def wired(name: str, part: Document) -> tuple[DacOptions, RigOptions, Mapping[str, Any]]:
        options = _device_options(part, path.parent, files)
        rig = _rig_options(name, part, options, simulated[name], names.index(name))
        return options, rig, part.data["device"]

    devices, axes = dict[Any, EmulatorOptions](), list[WiredAxis]()
    for name, (options, rig, section) in of_each_axis(axis_documents(document), wired).items():
        place = _place(options)
        made = devices.get(place) or _emulator_options(options, path.parent, host, port)
        devices[place] = replace(made, rigs=(*made.rigs, rig))
        axes.append(WiredAxis(name, section, [*devices].index(place), len(made.rigs)))
        port = 0  # of the first device
    return WiredExperiment(path, tuple(settings), tuple(axes), tuple(_apart(devices.values())))


def _apart(devices: Iterable[EmulatorOptions]) -> Iterator[EmulatorOptions]:
    """Yield the options of devices on ports of their own: free ones instead of one used twice."""
    used = {0}
    for each in devices:
        ports = []
        for wanted in (each.port, each.reader_port):
            ports.append(0 if wanted in used else wanted)
            used.add(wanted)
        yield replace(each, port=ports[0], reader_port=ports[1])


def _device_options(document: Document, folder: Path, files: TextFiles) -> DacOptions:
    section = document.data.get("device")
    name = section.get("profile") if isinstance(section, dict) else None
    if not isinstance(section, dict) or not isinstance(name, str):
        rule = "must name a profile: a device without one has no connection to emulate"
        raise ConfigError([document.problem("device.profile", rule)])
    # The options of a device of any protocol: those of serial_dac include all.
    context = {"folder": folder, "files": files}
    return document.validate(SerialOptions, at=("device",), without=("kind",), context=context)


def _place(options: DacOptions) -> tuple[Any, ...]:
    """Return a key that is equal for axes on the same device, with the same reader."""
    addresses = (options, options.reader)
    return tuple(
        each and (each.profile.name, each.host, each.tcp_port, each.serial_port, each.unit_id)
        for each in addresses
    )


def _rig_options(
    axis: str, document: Document, options: DacOptions, simulated: Document, number: int
) -> RigOptions:
    unit = "A" if options.amplifier is None else options.amplifier.command_unit
    actuator = _actuator(unit, simulated, document.data.get("amplifier"))
    return RigOptions(
        output=options.output,
        sensor=options.input,
        # Sensors have noise of their own.
        actuator=actuator.model_copy(update={"seed": actuator.seed + number}),
        wiring=(options.amplifier, options.sensor),
        limits=limited_range(document.data.get("limits")),
        axis=axis,
    )


def _emulator_options(
    options: DacOptions, folder: Path, host: str | None, port: int
) -> EmulatorOptions:
    """Return the options of a device's emulator, without rigs."""
    of_reader: dict[str, Any] = {}
    if (reader := options.reader) is not None:
        of_reader = {
            "reader": _found(reader.profile, folder),
            "reader_link": _link(reader),
            "reader_line": "own" if reader.host or reader.serial_port else "same",
            "reader_unit_id": reader.unit_id,
            "reader_port": _port(reader),
        }
    return EmulatorOptions(
        profile=_found(options.profile, folder),
        link=_link(options),
        host=host or EmulatorOptions.host,
        port=port or _port(options),
        rigs=(),
        **of_reader,
    )


def _actuator_document(settings: Sequence[str]) -> Document:
    """Return the options of the actuator that a user sets."""
    document = Document("--actuator", "{}")
    for each in settings:
        document.set(each, "--actuator")
    return document


def _by_axis(document: Document, axes: Sequence[str]) -> dict[str, Document]:
    """Return the options of the actuator of each axis: its own over those of all."""
    own = document.data.get("axes")
    if own is None or axes == [""]:
        return dict.fromkeys(axes, document)
    if not isinstance(own, dict) or not all(
        name in axes and isinstance(each, dict) for name, each in own.items()
    ):
        rule = f"must hold options of {names_text(axes)}"
        raise ConfigError([document.problem("axes", rule)])
    common = document.copied()
    common.remove("axes")
    return {name: document.part(("axes", name), name) if name in own else common for name in axes}


def _found(named: NamedProfile, folder: Path) -> str:
    """Return a profile's name, with the experiment's folder if it is a path."""
    path = Path(named.name)
    return str(folder / path) if path.suffix or len(path.parts) > 1 else named.name


def _port(options: AddressOptions) -> int:
    """Return the TCP port of options if users may listen there; otherwise 0, for a free one."""
    given = options.tcp_port or 0
    return given if options.host in _HERE and given >= _UNPRIVILEGED else 0


def _actuator(unit: CommandUnit, document: Document, amplifier: Any = None) -> SimulatedOptions:
    """Return the options of the actuator with a unit; ``amplifier`` is the experiment's section."""
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
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Override a dotted key of the experiment; may be repeated.",
        ),
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Log file for every write.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[OUTPUT:]KIND@WHEN",
            help="Fault at request KIND@COUNT or time KIND@SECONDSs; may be repeated. Kinds: "
            f"{', '.join(KINDS)}. {', '.join(LASTING)} take a duration: delay:0.3@500. OUTPUT, or "
            "an axis, has the fault from then on.",
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
            help="Option of the simulated actuator, such as load_kg=2, or axes.x.load_kg=2 for one"
            " axis; may be repeated.",
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
    """Emulate a device with simulated rigs, until Ctrl-C."""
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
        wired = wired_experiment(Path(profile), settings or (), port, host, actuator or ())
        devices = wired.options
    elif settings:
        raise InputError("--set: is for keys of an experiment")
    else:
        if reader is None and sensor is not None and ":" in sensor:
            own["reader"], _, sensor = sensor.rpartition(":")
        simulated = _actuator(unit or "A", _actuator_document(actuator or ()))
        rigs = (RigOptions(output, sensor, simulated),)
        devices = (EmulatorOptions(profile, host=host, port=port, rigs=rigs, **own),)
    faults = tuple(parse_fault(text) for text in fault or ())
    known = {rig.axis for each in devices for rig in each.rigs} - {""}
    known |= {name for each in devices for name in load_profile(each.profile).outputs}
    for each in faults:
        if each.output and each.output not in known:
            raise InputError(f"fault of {each.output}: must be of {', '.join(sorted(known))}")
    first = replace(devices[0], reader_port=reader_port or devices[0].reader_port)
    options = [
        replace(each, log=log, faults=faults, command=command) for each in (first, *devices[1:])
    ]
    serve(options, partial(_say, as_json=as_json, wired=wired))


def _say(emulators: Sequence[Emulator], *, as_json: bool, wired: WiredExperiment | None) -> None:
    axes = (WiredAxis("", {}, 0, 0),) if wired is None else wired.axes
    if as_json:
        places = [place._asdict() for each in emulators for place in each.places]
        wirings = {each.name: _wiring(emulators[each.device], each.rig) for each in axes}
        report = {"devices": places, "wiring": wirings.get("", wirings)}
        if wired is not None:
            report["arguments"] = wired.words(emulators)
        typer.echo(finite_json(report))
        return
    for number, emulator in enumerate(emulators):
        names = ", ".join(each.name for each in axes if each.name and each.device == number)
        for profile, address, unit_id in emulator.places:
            unit = f", unit {unit_id}" if unit_id is not None else ""
            typer.echo(f"{profile} answers at {address}{unit}{names and f' ({names})'}")
    for axis in axes:
        _say_wiring(axis.name and f"{axis.name}, ", emulators[axis.device], axis.rig)
    if wired is not None:
        typer.echo(f"hilctl {shlex.join(wired.words(emulators))}")


def _say_wiring(above: str, emulator: Emulator, rig: int) -> None:
    wiring, info = emulator.rigs[rig].wiring, emulator.rigs[rig].rig.actuator.info
    section = emulator.sections[rig]
    gain, offset, um_per_unit, offset_um = wiring.factors
    unit = wiring.command_unit
    drive = {"A": "current", "V": "voltage"}[unit]
    typer.echo(f"{above}{section['output']}: {drive} = {gain:g} {unit} x output {offset:+g} {unit}")
    shown = f"{um_per_unit:g} µm x input {offset_um:+g} µm"
    typer.echo(f"{above}{section['input']}: displacement = {shown}")
    limits = f"{info.command_min:g} to {info.command_max:g} {unit}"
    reach = f"{info.sensor_min_um:g} to {info.sensor_max_um:g} µm"
    typer.echo(f"{above}{info.name}: {limits}, {reach}")


def _wiring(emulator: Emulator, rig: int) -> dict[str, Any]:
    wiring, section = emulator.rigs[rig].wiring, emulator.sections[rig]
    suffix = wiring.command_unit.lower()
    names = f"gain_{suffix}", f"offset_{suffix}", "sensor_um", "offset_um"
    terminals = {key: section[key] for key in ("output", "input")}
    return terminals | dict(zip(names, wiring.factors, strict=True))


def serve(options: Sequence[EmulatorOptions], on_ready: Callable[[list[Emulator]], None]) -> None:
    """Serve emulators until SIGINT or SIGTERM; call ``on_ready`` once all devices answer."""
    emulators: list[Emulator] = []
    for each in options:
        emulators.append(build(each, beside=emulators[0] if emulators else None))
    server, log = emulators[0].server, emulators[0].log

    def stop(number: int, frame: FrameType | None) -> None:
        server.stop()

    gc.collect()
    gc.freeze()  # collecting all imported objects takes tens of ms
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        on_ready(emulators)
        server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        log.close()
