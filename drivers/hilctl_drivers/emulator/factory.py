"""Factory of emulators: a device that drives rigs, and optionally another that reads them.

Two Modbus devices share a line, or a gateway, by unit id, and two text devices a line by address;
or each has a port of its own, with any protocol.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import starmap
from typing import Any, Literal, NamedTuple, TypeAlias, cast

from hilctl.base.errors import InputError
from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.emulator.board_device import EmulatedBoard
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.options import EmulatorOptions, LinkKind, ReaderLine, RigOptions
from hilctl_drivers.emulator.rig import (
    ACTUATORS,
    Bench,
    SimulatedWiring,
    Stage,
    WiredRig,
    WriteLog,
)
from hilctl_drivers.emulator.sensor_stream import EmulatedStream
from hilctl_drivers.emulator.server import EmulatorServer
from hilctl_drivers.emulator.text_device import EmulatedText
from hilctl_drivers.emulator.wire import EmulatedLine, EmulatedWire, SerialProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import BaseProfile, Range, SerialLineSettings
from hilctl_drivers.sensor_stream.stream_profile import StreamProfile
from hilctl_drivers.simulated.devices import (
    PiezoOptions,
    PiezoStage,
    SimulatedTerfenol,
    TerfenolOptions,
)
from hilctl_drivers.simulated.simulated_device import SimulatedDevice

AnyDevice: TypeAlias = EmulatedModbus | EmulatedText | EmulatedBoard | EmulatedStream
_DRIVE_V, _RANGE_UM = 100.0, 50.0  # of a piezo stage if no wiring is given
_RANGE_SHARE = 0.8  # of the sensor's range, the most that rods move in the limits of an experiment
_SETTLED_NS = 100_000_000


class ListenAddress(NamedTuple):
    """Address of an emulated device."""

    profile: str
    address: str  # host:port or device file
    unit_id: int | None  # if another Modbus device is served beside it


@dataclass(frozen=True, slots=True)
class Emulator:
    """A server that is ready to run; close its log at the end."""

    server: EmulatorServer
    log: WriteLog
    device: AnyDevice  # drives the rigs
    reader: AnyDevice  # shows their displacements, often the same
    rigs: tuple[WiredRig, ...]
    wires: tuple[EmulatedWire, ...]  # one, or the reader's too
    places: tuple[ListenAddress, ...]  # of the device, and of the reader if it is another one
    sections: tuple[dict[str, Any], ...]  # address and wiring per rig, as an experiment's device

    @property
    def address(self) -> str:
        """Address of the device."""
        return self.places[0].address

    @property
    def options(self) -> dict[str, Any]:
        """The device section for the first rig."""
        return self.sections[0]


def build(
    options: EmulatorOptions,
    clock_ns: Callable[[], int] = time.monotonic_ns,
    beside: "Emulator | None" = None,
) -> Emulator:
    """Return an emulator with open ports and one clock; raise InputError for wrong options.

    One ``beside`` another has the server and the log of that one.
    """
    plan = _Plan(options)
    now_ns = clock_ns()
    if beside is None:
        log = WriteLog(options.log, time.time_ns() - now_ns)
        server = EmulatorServer(options.faults, clock_ns)
    else:
        log, server = beside.log, beside.server
    rigs = plan.rigs(now_ns)
    device, reader, wires = plan.devices(rigs, log)
    try:
        addresses = [each.open(server, wire, options.host) for each, wire in wires]
    except InputError:
        server.close()
        log.close()
        raise
    return Emulator(
        server=server,
        log=log,
        device=device,
        reader=reader,
        rigs=rigs,
        wires=tuple(wire for _, wire in wires),
        places=plan.listen_addresses(addresses),
        sections=tuple({**each, **plan.places(addresses)} for each in plan.channels()),
    )


class _Plan:
    """The profiles, channels and links of options, and the wiring between them."""

    def __init__(self, options: EmulatorOptions) -> None:
        self._options = options
        self._served = self._shown = _Served.of(options.profile, options.link, options.port)
        if options.reader is not None:
            link = options.reader_link or options.link
            self._shown = _Served.of(options.reader, link, options.reader_port, faulty=False)
        self._profile, self._reader = profile, reader = self._served.profile, self._shown.profile
        outputs, sensors = list(profile.outputs), list(reader.sensor_inputs)
        faults = {each.kind for each in options.faults}
        self._terminals: list[tuple[str, str]] = []  # output and input of each rig
        self._rigs: dict[str, tuple[SimulatedDevice, SimulatedWiring]] = {}
        """By axis, or by output without axes."""
        for each in options.rigs:
            output = _chosen("output to drive the rig with", each.output, outputs, profile)
            sensor = _chosen("input to show a displacement at", each.sensor, sensors, reader)
            source = reader.inputs[sensor]
            markers = [getattr(source, key, None) for key in ("validity", "invalid", "valid")]
            if set(markers) <= {"none", None} and "invalid" in faults:
                raise InputError(
                    f"fault invalid: {sensor} of {reader.title} has no validity, invalid or valid"
                )
            self._terminals.append((output, sensor))
            self._rigs[each.axis or output] = _rig(each, profile.outputs[output], source)
        self._check_rigs()
        if "stall" in faults and not isinstance(reader, StreamProfile):
            raise InputError(f"fault stall: {reader.title} sends no unsolicited samples")
        self._apart = reader is not profile and not self._may_share(options.reader_line)
        """Whether the reader has its own wire."""
        self.reader_unit_id = self._unit_of_reader()
        if "reset" in faults and not (self._served.tcp and self._shown.tcp):
            raise InputError("fault reset is for tcp: a serial line has no connection to break")

    def _check_rigs(self) -> None:
        """Raise InputError if rigs share a terminal, or one sees an axis that is not here."""
        for names in zip(*self._terminals, strict=True):
            for name in names:
                if names.count(name) > 1:
                    raise InputError(f"{name} must not have two rigs")
        for actuator, _ in self._rigs.values():
            for axis in actuator.crosstalk.keys() - self._rigs.keys():
                here = ", ".join(self._rigs)
                raise InputError(f"crosstalk of {axis}: must be an axis of the device ({here})")

    def _may_share(self, wanted: ReaderLine | None) -> bool:
        """Return whether the reader is on the line of the device; raise InputError if it cannot."""
        profile, reader = self._profile, self._reader
        alike = type(profile) is type(reader) and reader.link.kind not in {
            "bytes",
            "bytes_tcp",
            "frames",
        }
        if wanted == "same" and not alike:
            raise InputError(f"{reader.title} cannot share the line of {profile.title}: use own")
        shares = wanted or ("same" if reader.link.kind == "rtu" else "own")
        links = {(each.tcp, each.framing) for each in (self._served, self._shown)}
        return alike and shares == "same" and len(links) == 1

    def _unit_of_reader(self) -> int | None:
        """Return the reader's unit id on Modbus; on the same line it must not be the other's."""
        profile, reader, wanted = self._profile, self._reader, self._options.reader_unit_id
        if not isinstance(reader, ModbusProfile):
            if wanted is not None:
                raise InputError(f"reader_unit_id is for Modbus, not for {reader.title}")
            return None
        if self._apart or not isinstance(profile, ModbusProfile) or reader is profile:
            return reader.unit_id if wanted is None else wanted
        if wanted == profile.unit_id:
            raise InputError(f"reader_unit_id must not be {wanted}, that of {profile.title}")
        return reader.unit_id + (reader.unit_id == profile.unit_id) if wanted is None else wanted

    def rigs(self, now_ns: int) -> tuple[WiredRig, ...]:
        """Return the rigs of a stage, at rest."""
        stage = Stage(now_ns, {axis: actuator for axis, (actuator, _) in self._rigs.items()})
        axes = (each.axis for each in self._options.rigs)
        wirings = (wiring for _, wiring in self._rigs.values())
        return tuple(starmap(WiredRig, zip(stage.rigs, wirings, axes, strict=True)))

    def devices(
        self, rigs: Sequence[WiredRig], log: WriteLog
    ) -> tuple[AnyDevice, AnyDevice, list[tuple["_Served", EmulatedWire]]]:
        """Return the devices that drive and show the rigs, and the wires to serve."""
        served, shown = self._served, self._shown
        here, unit = self._profile.usual_unit, self.reader_unit_id
        outputs, sensors = zip(*self._terminals, strict=True)
        driving = dict(zip(outputs, rigs, strict=True))
        showing = dict(zip(sensors, rigs, strict=True))
        if served is shown:
            device = self._device(self._profile, Bench(driving, showing, log))
            return device, device, [(served, served.wire({here: device}))]
        device = self._device(self._profile, Bench(driving, {}, log))
        reader = self._device(self._reader, Bench({}, showing, log))
        if self._apart:
            wires = served.wire({here: device}), shown.wire({unit: reader})
            return device, reader, [(served, wires[0]), (shown, wires[1])]
        unit = self._reader.usual_unit if unit is None else unit
        both = served.wire({unit: reader, here: device})
        return device, reader, [(served, both)]

    def _device(self, profile: BaseProfile, bench: Bench) -> AnyDevice:
        command = self._options.command if bench.driven else None
        if isinstance(profile, ModbusProfile):
            return EmulatedModbus(profile, bench, command)
        if command is not None:
            raise InputError(f"initial command is for Modbus profiles, not for {profile.title}")
        if isinstance(profile, StreamProfile):
            return EmulatedStream(profile, bench)
        if isinstance(profile, FrameProfile):
            return EmulatedBoard(profile, bench)
        assert isinstance(profile, AsciiProfile)
        return EmulatedText(profile, bench)

    def channels(self) -> Iterator[dict[str, Any]]:
        """Yield the part of each rig's device section with profile, channels and wiring."""
        for (output, source), (_, wiring) in zip(self._terminals, self._rigs.values(), strict=True):
            made: dict[str, Any] = {
                "profile": self._options.profile,
                "output": output,
                "input": source,
                "sensor": wiring.sensor.model_dump(exclude_none=True),
                "watchdog": "none",
            }
            if wiring.amplifier is not None:
                made["amplifier"] = wiring.amplifier.model_dump(exclude_none=True)
            yield made

    def listen_addresses(self, addresses: list[str]) -> tuple[ListenAddress, ...]:
        """Return the addresses of the devices, with their unit ids if there are two."""
        options, profile = self._options, self._profile
        if options.reader is None:
            return (ListenAddress(options.profile, addresses[0], None),)
        units: tuple[int | None, int | None] = None, None
        if isinstance(profile, ModbusProfile):
            units = profile.unit_id, self.reader_unit_id
        return (
            ListenAddress(options.profile, addresses[0], units[0]),
            ListenAddress(options.reader, addresses[-1], units[1]),
        )

    def places(self, addresses: list[str]) -> dict[str, Any]:
        """Return the part of a device section with the addresses of the devices."""
        made = self._served.place(addresses[0])
        if self._reader is not self._profile:
            unit = {} if self.reader_unit_id is None else {"unit_id": self.reader_unit_id}
            place = self._shown.place(addresses[1]) if self._apart else {}
            made["reader"] = {"profile": self._options.reader, **unit, **place}
        return made


@dataclass(frozen=True, slots=True)
class _Served:
    """A device, and how it is served: on a TCP port or a pty, and the frames of Modbus."""

    profile: BaseProfile
    tcp: bool
    framing: Literal["tcp", "rtu"]
    port: int  # 0 for a free one
    faulty: bool  # whether faults happen on its pty

    @classmethod
    def of(cls, name: str, wanted: LinkKind | None, port: int, *, faulty: bool = True) -> "_Served":
        """Return the serving options of a device: those set, otherwise those of its profile."""
        profile = load_profile(name)
        if isinstance(profile, ModbusProfile):
            kind = wanted or profile.link.kind
            return cls(profile, kind != "rtu", "tcp" if kind == "tcp" else "rtu", port, True)
        on_line = isinstance(profile.link, SerialLineSettings)
        return cls(profile, wanted == "tcp" or not on_line, "rtu", port, faulty)

    def wire(self, devices: dict[Any, Any]) -> EmulatedWire:
        """Return a wire with devices by unit; the last one is asked first."""
        if isinstance(self.profile, ModbusProfile):
            return ModbusWire(self.framing, devices)
        members = list(devices.values())[::-1]
        if isinstance(self.profile, StreamProfile):
            return cast(EmulatedStream, members[0])
        assert isinstance(self.profile, SerialProfile)
        return EmulatedLine(self.profile, members)

    def open(self, server: EmulatorServer, wire: EmulatedWire, host: str) -> str:
        """Serve a wire, and return its address."""
        if self.profile.link.kind == "sensor_stream_udp":
            return server.send_udp(wire, host, self.port)
        if self.tcp:
            return server.listen_tcp(wire, host, self.port)
        return server.open_pty(wire, faulty=self.faulty)

    def place(self, address: str) -> dict[str, Any]:
        """Return an address in the form of a device section."""
        if not self.tcp:
            return {"serial_port": address}
        host, _, port = address.rpartition(":")
        usual = next(iter(self.profile.framings), "rtu")
        framed = {} if self.framing == usual else {"framing": self.framing}
        return {"host": host, "tcp_port": int(port), **framed}


def _rig(
    options: RigOptions, output: Range, sensor_input: Range
) -> tuple[SimulatedDevice, SimulatedWiring]:
    """Return the actuator and its wiring to an output and an input; each may follow the other."""
    actuator, given, limits = options.actuator, options.wiring, options.limits
    wiring = None if given is None else SimulatedWiring(output, sensor_input, *given)
    if limits is not None and isinstance(actuator, TerfenolOptions):
        # Options of the user take precedence.
        rated = {"rated_current_a": max(map(abs, limits))} | actuator.model_dump(exclude_unset=True)
        actuator = TerfenolOptions.model_validate(rated)
        if wiring is not None and "vary" not in rated:
            range_um = max(map(abs, wiring.displacement_range))
            strain = _RANGE_SHARE * range_um / _stroke_um(actuator, max(limits, key=abs))
            rated["vary"] = {"strain": min(1.0, strain)}
            actuator = TerfenolOptions.model_validate(rated)
    if isinstance(actuator, PiezoOptions) and actuator.stage is None:
        if wiring is None:  # 0 V of an output drives with 0 V
            share = min(0.0, output.min) / max(abs(output.min), abs(output.max))
            drive_v: Sequence[float] = (share * _DRIVE_V, _DRIVE_V)
            range_um = _RANGE_UM
        else:
            drive_v = wiring.command_range
            range_um = max(map(abs, wiring.displacement_range))
        stage = PiezoStage.fitted(drive_v, range_um, max(map(abs, limits or drive_v)))
        actuator = actuator.model_copy(update={"stage": stage})
    make: Any = next(each for each in ACTUATORS.values() if each.Options is type(actuator))
    device: SimulatedDevice = make(actuator)
    wiring = wiring or SimulatedWiring.spread(output, sensor_input, device)
    unit = device.info.command_unit
    if wiring.command_unit != unit:
        raise InputError(
            f"{device.info.name} is driven in {unit}, but the output drives in "
            f"{wiring.command_unit}: use --unit {wiring.command_unit}"
        )
    return device, wiring


def _stroke_um(actuator: TerfenolOptions, command: float) -> float:
    """Return the displacement of an actuator in um, some time after a step to a command."""
    alone = actuator.model_copy(update={"crosstalk": {}})
    stage = Stage(0, {"": SimulatedTerfenol(alone)})
    (rig,) = stage.rigs
    rig.put_out(command, 0)
    stage.advance(_SETTLED_NS)
    return abs(rig.displacement_um)


def _chosen(what: str, name: str | None, names: list[str], profile: BaseProfile) -> str:
    if name in names:
        return str(name)
    if name is not None:
        raise InputError(f"{profile.title} has no {name}: {', '.join(names) or 'none'}")
    if not names:
        rest = "name a reader" if profile.outputs else "it can be another one's reader"
        raise InputError(f"{profile.title} has no {what}: {rest}")
    return names[0]
