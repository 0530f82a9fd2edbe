"""Factory of emulators: a device that drives the rig, and optionally another that reads it.

Two Modbus devices share a line, or a gateway, by unit id, and two text devices a line by address;
or each has a port of its own.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

from hilctl.base.errors import InputError
from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.emulator.board_device import EmulatedBoard
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.emulator.rig import ACTUATORS, Bench, Rig, SimulatedWiring, WriteLog
from hilctl_drivers.emulator.server import EmulatorServer
from hilctl_drivers.emulator.text_device import EmulatedText
from hilctl_drivers.emulator.wire import EmulatedLine, EmulatedWire, SerialProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import BaseProfile, Range
from hilctl_drivers.simulated.devices import PiezoOptions, PiezoStage, SimulatedDevice

ProfileT = TypeVar("ProfileT", bound=BaseProfile)
AnyDevice: TypeAlias = EmulatedModbus | EmulatedText | EmulatedBoard
_DRIVE_V, _RANGE_UM = 100.0, 50.0  # of a piezo stage if no wiring is given


class _Port(NamedTuple):
    """A wire and its TCP port, 0 for a free one; None for a pty."""

    wire: EmulatedWire
    tcp_port: int | None = None
    faulty: bool = True


@dataclass(frozen=True, slots=True)
class Emulator:
    """A server that is ready to run; its log is to be closed at the end."""

    server: EmulatorServer
    log: WriteLog
    device: AnyDevice  # drives the rig
    reader: AnyDevice  # shows the displacement, often the same
    actuator: SimulatedDevice
    wires: tuple[EmulatedWire, ...]  # one, or the reader's too
    address: str  # host:port, or the pty's device file
    reader_address: str
    reader_unit_id: int | None  # None if it is no Modbus device
    options: dict[str, Any]  # address and wiring, as in an experiment's device section


def build(options: EmulatorOptions, clock_ns: Callable[[], int] = time.monotonic_ns) -> Emulator:
    """Return an emulator with open ports and one clock; raise InputError for wrong options."""
    plan = _plan(options)
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
        address=addresses[0],
        reader_address=addresses[-1],
        reader_unit_id=plan.reader_unit_id,
        options={**plan.channels(), **plan.places(addresses)},
    )


def _opened(server: EmulatorServer, port: _Port, host: str) -> str:
    if port.tcp_port is None:
        return server.open_pty(port.wire, faulty=port.faulty)
    return server.listen_tcp(port.wire, host, port.tcp_port)


def _plan(options: EmulatorOptions) -> "_ModbusPlan | _SerialPlan":
    """Check the options against the profiles; nothing is opened or written."""
    profile = load_profile(options.profile)
    reader = profile if options.reader is None else load_profile(options.reader)
    if isinstance(profile, ModbusProfile):
        if not isinstance(reader, ModbusProfile):
            raise InputError(f"{options.reader}: only Modbus profiles read for {profile.title}")
        return _ModbusPlan(options, profile, reader)
    given = (options.link, options.reader_unit_id, options.reader_port, options.command)
    if given != (None, None, 0, None):
        rule = "link, initial command and the reader's unit and port are for Modbus profiles"
        raise InputError(f"{rule}, {options.profile} has a line of its own")
    if isinstance(profile, FrameProfile):
        if reader is not profile:
            raise InputError(f"{profile.title} reads its own sensor: it takes no reader")
        return _SerialPlan(options, profile, profile)
    if not (isinstance(profile, AsciiProfile) and isinstance(reader, AsciiProfile)):
        raise InputError(f"{options.reader}: only text profiles read for {profile.title}")
    return _SerialPlan(options, profile, reader)


class _Plan(Generic[ProfileT]):
    """The profiles and channels of options, and the wiring between them."""

    reader_unit_id: int | None = None

    def __init__(self, options: EmulatorOptions, profile: ProfileT, reader: ProfileT) -> None:
        self._options, self._profile, self._reader = options, profile, reader
        sensors = [
            name
            for name, each in reader.inputs.items()
            if getattr(each, "measures", "terminal") == "terminal"
        ]
        outputs = list(profile.outputs)
        self._output = _chosen("output to drive the rig with", options.output, outputs, profile)
        self._sensor = _chosen("input to show a displacement at", options.sensor, sensors, reader)
        self.actuator, self.wiring = _rig(
            options, profile.outputs[self._output], reader.inputs[self._sensor]
        )
        self._apart = reader is not profile
        """Whether the reader is on a wire of its own."""

    def _refuse_resets(self) -> None:
        if any(fault.kind == "reset" for fault in self._options.faults):
            raise InputError("fault reset is for tcp: a serial line has no connection to break")

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

    def places(self, addresses: list[str]) -> dict[str, Any]:
        """Return the part of a device section with the addresses of the devices."""
        made = _place(addresses[0])
        if self._reader is not self._profile:
            unit = {} if self.reader_unit_id is None else {"unit_id": self.reader_unit_id}
            place = _place(addresses[1]) if self._apart else {}
            made["reader"] = {"profile": self._options.reader, **unit, **place}
        return made


def _rig(
    options: EmulatorOptions, output: Range, sensor_input: Range
) -> tuple[SimulatedDevice, SimulatedWiring]:
    """Return the actuator and its wiring to an output and an input; each may follow the other."""
    actuator, given = options.actuator, options.wiring
    wiring = None if given is None else SimulatedWiring(output, sensor_input, *given)
    if isinstance(actuator, PiezoOptions) and actuator.stage is None:
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


def _place(address: str) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    return {"host": host, "tcp_port": int(port)} if host else {"serial_port": address}


class _ModbusPlan(_Plan[ModbusProfile]):
    def __init__(
        self, options: EmulatorOptions, profile: ModbusProfile, reader: ModbusProfile
    ) -> None:
        super().__init__(options, profile, reader)
        self._links = (options.link or profile.link.kind, options.link or reader.link.kind)
        line = options.reader_line or ("own" if reader.link.kind == "tcp" else "same")
        self._apart &= line == "own" or self._links[0] != self._links[1]
        self.reader_unit_id = self._unit_of_reader()
        if "rtu" in self._links:
            self._refuse_resets()

    def _unit_of_reader(self) -> int:
        """Return the reader's unit id; on the same line it must not be the other's."""
        profile, reader, wanted = self._profile, self._reader, self._options.reader_unit_id
        if self._apart or reader is profile:
            return reader.unit_id if wanted is None else wanted
        if wanted == profile.unit_id:
            raise InputError(f"reader_unit_id must not be {wanted}, that of {profile.title}")
        return reader.unit_id + (reader.unit_id == profile.unit_id) if wanted is None else wanted

    def devices(self, bench: Bench) -> tuple[AnyDevice, AnyDevice, list[_Port]]:
        """Return the devices that drive and show the rig, and where they are served."""
        options, output, sensor = self._options, self._output, self._sensor
        reads_itself = self._reader is self._profile
        device = reader = EmulatedModbus(
            self._profile, bench, output, sensor if reads_itself else None, options.command
        )  # fmt: skip
        if not reads_itself:
            reader = EmulatedModbus(self._reader, bench, None, sensor)
        assert self.reader_unit_id is not None
        own, other = {self._profile.unit_id: device}, {self.reader_unit_id: reader}
        served = [(own, 0), (other, 1)] if self._apart else [(other | own, 0)]
        return device, reader, [self._port(which, devices) for devices, which in served]

    def _port(self, which: int, devices: dict[int, EmulatedModbus]) -> _Port:
        options, link = self._options, self._links[which]
        wire = ModbusWire(link, devices, options.lacking, options.mute)
        return _Port(wire, (options.port, options.reader_port)[which] if link == "tcp" else None)


class _SerialPlan(_Plan[SerialProfile]):
    def __init__(
        self, options: EmulatorOptions, profile: SerialProfile, reader: SerialProfile
    ) -> None:
        super().__init__(options, profile, reader)
        self._refuse_resets()
        self._apart &= options.reader_line != "same"

    def devices(self, bench: Bench) -> tuple[AnyDevice, AnyDevice, list[_Port]]:
        """Return the devices that drive and show the rig, and where they are served."""
        profile, reader = self._profile, self._reader
        if isinstance(profile, FrameProfile):
            board = EmulatedBoard(profile, bench)
            return board, board, [_Port(EmulatedLine(profile, [board]))]
        assert isinstance(reader, AsciiProfile)
        if reader is profile:
            text = EmulatedText(profile, bench, self._output, self._sensor)
            return text, text, [_Port(EmulatedLine(profile, [text]))]
        drives = EmulatedText(profile, bench, self._output, None)
        reads = EmulatedText(reader, bench, None, self._sensor)
        if not self._apart:
            return drives, reads, [_Port(EmulatedLine(profile, [drives, reads]))]
        ports = [_Port(EmulatedLine(profile, [drives]))]
        return drives, reads, [*ports, _Port(EmulatedLine(reader, [reads]), faulty=False)]


def _chosen(what: str, name: str | None, names: list[str], profile: BaseProfile) -> str:
    if name in names:
        return str(name)
    if name is not None:
        raise InputError(f"{profile.title} has no {name}: {', '.join(names) or 'none'}")
    if not names:
        rest = "name a reader" if profile.outputs else "it can be another one's reader"
        raise InputError(f"{profile.title} has no {what}: {rest}")
    return names[0]
