"""Factory of emulators: a device that drives the rig, and optionally another that reads it.

Two Modbus devices share a line, or a gateway, by unit id, and two text devices a line by address;
or each has a port of its own, with any protocol.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from hilctl.base.errors import InputError
from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.emulator.board_device import EmulatedBoard
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.options import EmulatorOptions, LinkKind, ReaderLine
from hilctl_drivers.emulator.rig import ACTUATORS, Bench, Rig, SimulatedWiring, WriteLog
from hilctl_drivers.emulator.sensor_stream import EmulatedStream
from hilctl_drivers.emulator.server import EmulatorServer
from hilctl_drivers.emulator.text_device import EmulatedText
from hilctl_drivers.emulator.wire import EmulatedLine, EmulatedWire, SerialProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import BaseProfile, Range, SerialLineSettings
from hilctl_drivers.sensor_stream.stream_profile import StreamProfile
from hilctl_drivers.simulated.devices import PiezoOptions, PiezoStage, SimulatedDevice

AnyDevice: TypeAlias = EmulatedModbus | EmulatedText | EmulatedBoard | EmulatedStream
_DRIVE_V, _RANGE_UM = 100.0, 50.0  # of a piezo stage if no wiring is given


class _Port(NamedTuple):
    """A wire and its TCP port, 0 for a free one; None for a pty."""

    wire: EmulatedWire
    tcp_port: int | None = None
    faulty: bool = True


class ListenAddress(NamedTuple):
    """Address of an emulated device."""

    profile: str
    address: str  # host:port or device file
    unit_id: int | None  # if another Modbus device is served beside it


@dataclass(frozen=True, slots=True)
class Emulator:
    """A server that is ready to run; its log is to be closed at the end."""

    server: EmulatorServer
    log: WriteLog
    device: AnyDevice  # drives the rig
    reader: AnyDevice  # shows the displacement, often the same
    actuator: SimulatedDevice
    wires: tuple[EmulatedWire, ...]  # one, or the reader's too
    places: tuple[ListenAddress, ...]  # of the device, and of the reader if it is another one
    options: dict[str, Any]  # address and wiring, as in an experiment's device section

    @property
    def address(self) -> str:
        """Address of the device."""
        return self.places[0].address


def build(options: EmulatorOptions, clock_ns: Callable[[], int] = time.monotonic_ns) -> Emulator:
    """Return an emulator with open ports and one clock; raise InputError for wrong options."""
    plan = _Plan(options)
    now_ns = clock_ns()
    log = WriteLog(options.log, time.time_ns() - now_ns)
    server = EmulatorServer(options.faults, clock_ns)
    bench = Bench(Rig(now_ns, plan.actuator), plan.wiring, log)
    device, reader, ports = plan.devices(bench)
    try:
        addresses = [_opened(server, port, options.host) for port in ports]
    except InputError:
        server.close()
        log.close()
        raise
    return Emulator(
        server=server,
        log=log,
        device=device,
        reader=reader,
        actuator=plan.actuator,
        wires=tuple(port.wire for port in ports),
        places=plan.listen_addresses(addresses),
        options={**plan.channels(), **plan.places(addresses)},
    )


def _opened(server: EmulatorServer, port: _Port, host: str) -> str:
    if port.tcp_port is None:
        return server.open_pty(port.wire, faulty=port.faulty)
    return server.listen_tcp(port.wire, host, port.tcp_port)


class _Plan:
    """The profiles, channels and links of options, and the wiring between them."""

    def __init__(self, options: EmulatorOptions) -> None:
        self._options = options
        self._profile = profile = load_profile(options.profile)
        self._reader = reader = profile if options.reader is None else load_profile(options.reader)
        outputs, sensors = list(profile.outputs), list(reader.sensor_inputs)
        self._output = _chosen("output to drive the rig with", options.output, outputs, profile)
        self._sensor = _chosen("input to show a displacement at", options.sensor, sensors, reader)
        source = reader.inputs[self._sensor]
        self.actuator, self.wiring = _rig(options, profile.outputs[self._output], source)
        markers = [getattr(source, key, None) for key in ("validity", "invalid", "valid")]
        if set(markers) <= {"none", None} and any(
            each.kind == "invalid" for each in options.faults
        ):
            raise InputError(
                f"fault invalid: {self._sensor} of {reader.title} has no validity, invalid or valid"
            )
        stalls = any(each.kind == "stall" for each in options.faults)
        if stalls and not isinstance(reader, StreamProfile):
            raise InputError(f"fault stall: {reader.title} does not send unasked")
        self._links = (
            _Served.of(profile, options.link),
            _Served.of(reader, options.reader_link or options.link),
        )
        self._apart = reader is not profile and not self._may_share(options.reader_line)
        """Whether the reader is on a wire of its own."""
        self.reader_unit_id = self._unit_of_reader()
        if any(fault.kind == "reset" for fault in options.faults) and not all(
            link.tcp for link in self._links
        ):
            raise InputError("fault reset is for tcp: a serial line has no connection to break")

    def _may_share(self, wanted: ReaderLine | None) -> bool:
        """Return whether the reader is on the line of the device; raise InputError if it can't."""
        profile, reader = self._profile, self._reader
        alike = type(profile) is type(reader) and reader.link.kind not in {"bytes", "frames"}
        if wanted == "same" and not alike:
            raise InputError(f"{reader.title} can't share the line of {profile.title}: use own")
        shares = wanted or ("same" if reader.link.kind == "rtu" else "own")
        return alike and shares == "same" and self._links[0] == self._links[1]

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

    def devices(self, bench: Bench) -> tuple[AnyDevice, AnyDevice, list[_Port]]:
        """Return the devices that drive and show the rig, and where they are served."""
        reads_itself = self._reader is self._profile
        device = reader = self._device(
            self._profile, bench, self._output, self._sensor if reads_itself else None
        )
        if not reads_itself:
            reader = self._device(self._reader, bench, None, self._sensor)
        if reads_itself or self._apart:
            ports = [self._port(0, {self._profile.usual_unit: device})]
            if self._apart:
                ports.append(self._port(1, {self.reader_unit_id: reader}))
            return device, reader, ports
        unit = self.reader_unit_id if self.reader_unit_id is not None else self._reader.usual_unit
        return device, reader, [self._port(0, {unit: reader, self._profile.usual_unit: device})]

    def _device(
        self, profile: BaseProfile, bench: Bench, output: str | None, sensor: str | None
    ) -> AnyDevice:
        options = self._options
        if isinstance(profile, ModbusProfile):
            return EmulatedModbus(
                profile, bench, output, sensor, options.command if output else None
            )
        if options.command is not None and output is not None:
            raise InputError(f"initial command is for Modbus profiles, not for {profile.title}")
        if isinstance(profile, StreamProfile) and sensor is not None:
            return EmulatedStream(profile, bench, sensor)
        if isinstance(profile, FrameProfile):
            return EmulatedBoard(profile, bench, output, sensor)
        assert isinstance(profile, AsciiProfile)
        return EmulatedText(profile, bench, output, sensor)

    def _port(self, which: int, devices: dict[int | None, AnyDevice]) -> _Port:
        options, link = self._options, self._links[which]
        profile = (self._profile, self._reader)[which]
        wire: EmulatedWire
        if isinstance(profile, ModbusProfile):
            units: Any = devices
            wire = ModbusWire(link.framing, units, options.lacking, options.mute)
        elif isinstance(profile, StreamProfile):
            (only,) = devices.values()
            assert isinstance(only, EmulatedStream)
            wire = only
        else:
            assert isinstance(profile, SerialProfile)
            members: Any = list(devices.values())[::-1]
            wire = EmulatedLine(profile, members)
        port = (options.port, options.reader_port)[which] if link.tcp else None
        return _Port(wire, port, faulty=which == 0 or isinstance(profile, ModbusProfile))

    def channels(self) -> dict[str, Any]:
        """Return the part of a device section with profile, channels and wiring."""
        amplifier, sensor = self.wiring.amplifier, self.wiring.sensor
        made: dict[str, Any] = {
            "profile": self._options.profile,
            "output": self._output,
            "input": self._sensor,
            "sensor": sensor.model_dump(exclude_none=True),
            "watchdog": "none",
        }
        if amplifier is not None:
            made["amplifier"] = amplifier.model_dump(exclude_none=True)
        return made

    def listen_addresses(self, addresses: list[str]) -> tuple[ListenAddress, ...]:
        """Return where the devices are served, with their unit ids if there are two."""
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
        made = self._place(0, addresses[0])
        if self._reader is not self._profile:
            unit = {} if self.reader_unit_id is None else {"unit_id": self.reader_unit_id}
            place = self._place(1, addresses[1]) if self._apart else {}
            made["reader"] = {"profile": self._options.reader, **unit, **place}
        return made

    def _place(self, which: int, address: str) -> dict[str, Any]:
        if not self._links[which].tcp:
            return {"serial_port": address}
        host, _, port = address.rpartition(":")
        usual = next(iter((self._profile, self._reader)[which].framings), "rtu")
        framing = self._links[which].framing
        framed = {} if framing == usual else {"framing": framing}
        return {"host": host, "tcp_port": int(port), **framed}


class _Served(NamedTuple):
    """How a device is served: on a TCP port or a pty, and the frames of Modbus."""

    tcp: bool
    framing: Literal["tcp", "rtu"]

    @classmethod
    def of(cls, profile: BaseProfile, wanted: LinkKind | None) -> "_Served":
        """Return what an option wants of a device, or what its profile says."""
        if isinstance(profile, ModbusProfile):
            kind = wanted or profile.link.kind
            return cls(kind != "rtu", "tcp" if kind == "tcp" else "rtu")
        on_line = isinstance(profile.link, SerialLineSettings)
        return cls(wanted == "tcp" or not on_line, "rtu")


def _rig(
    options: EmulatorOptions, output: Range, sensor_input: Range
) -> tuple[SimulatedDevice, SimulatedWiring]:
    """Return the actuator and its wiring to an output and an input; each may follow the other."""
    actuator, given = options.actuator, options.wiring
    wiring = None if given is None else SimulatedWiring(output, sensor_input, *given)
    if isinstance(actuator, PiezoOptions) and (actuator.physics, actuator.stage) == ("plays", None):
        if wiring is None:  # 0 V of an output drives with 0 V
            share = min(0.0, output.min) / max(abs(output.min), abs(output.max))
            stage = PiezoStage.fitted(share * _DRIVE_V, _DRIVE_V, _RANGE_UM)
        else:
            (low_v, high_v), reach_um = wiring.command_range, wiring.displacement_range
            stage = PiezoStage.fitted(low_v, high_v, max(map(abs, reach_um)))
        actuator = actuator.model_copy(update={"stage": stage})
    device = next(make(actuator) for kind, make in ACTUATORS.values() if kind is type(actuator))
    wiring = wiring or SimulatedWiring.spread(output, sensor_input, device)
    unit = device.info.command_unit
    if wiring.command_unit != unit:
        raise InputError(
            f"{device.info.name} is driven in {unit}, but the output drives in "
            f"{wiring.command_unit}: use --unit {wiring.command_unit}"
        )
    return device, wiring


def _chosen(what: str, name: str | None, names: list[str], profile: BaseProfile) -> str:
    if name in names:
        return str(name)
    if name is not None:
        raise InputError(f"{profile.title} has no {name}: {', '.join(names) or 'none'}")
    if not names:
        rest = "name a reader" if profile.outputs else "it can be another one's reader"
        raise InputError(f"{profile.title} has no {what}: {rest}")
    return names[0]
