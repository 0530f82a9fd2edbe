"""Puts emulated Modbus devices together: one that drives the rig, and often another that reads it.

Two devices share a line, or a gateway, by unit id; or each has a port of its own.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.emulated import EmulatedDevice
from hilctl_drivers.emulator.faults import Fault
from hilctl_drivers.emulator.labjack_attach import attach_stream
from hilctl_drivers.emulator.modbus_server import ModbusServer
from hilctl_drivers.emulator.modbus_wire import LinkKind, ModbusWire
from hilctl_drivers.emulator.rig import Rig
from hilctl_drivers.emulator.wiring import Wiring
from hilctl_drivers.emulator.write_log import WriteLog
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.profile import load_profile

ReaderLine: TypeAlias = Literal["same", "own"]
_SUFFIX = {"V": "v", "mA": "ma", "A": "a"}


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What to emulate.

    Attributes:
        profile: Name of a shipped profile, or path of one.
        link: ``tcp``, or ``rtu`` on a pty; the profile's own where None.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        output: Output that drives the rig; the profile's first where None.
        sensor: Input that shows the displacement; the first that a sensor can be wired to.
        reader: Profile of the device that has the input, where it is another one.
        reader_line: ``same`` line or connection, or its ``own``; own where it is a Modbus TCP
            device and this is None.
        reader_unit_id: Its unit id; its profile's, or the next on the same line, where None.
        reader_port: TCP port of its own; 0 takes a free one.
        log: File for a log of every write.
        faults: What goes wrong.
        lacking: Functions that are refused with exception 1.
        mute: Functions that are never answered.
        wiring: Amplifier and sensor; spread over the channels' ranges where None.
        noise: Whether the sensor has noise.
    """

    profile: str
    link: LinkKind | None = None
    host: str = "127.0.0.1"
    port: int = 0
    output: str | None = None
    sensor: str | None = None
    reader: str | None = None
    reader_line: ReaderLine | None = None
    reader_unit_id: int | None = None
    reader_port: int = 0
    log: Path | None = None
    faults: tuple[Fault, ...] = ()
    lacking: frozenset[int] = frozenset()
    mute: frozenset[int] = frozenset()
    wiring: Wiring | None = None
    noise: bool = True


@dataclass(frozen=True, slots=True)
class Emulator:
    """A server that is ready to run.

    Attributes:
        server: Run it.
        address: ``host:port``, or the pty's device file.
        device: What drives the rig.
        log: Close it at the end.
        options: What ``modbus_dac`` needs to be told, as in an experiment's device section.
        reader: What shows the displacement; ``device`` where it does so itself.
        reader_address: Where that is.
        reader_unit_id: Its unit id there.
    """

    server: ModbusServer
    address: str
    device: EmulatedDevice
    log: WriteLog
    reader: EmulatedDevice
    reader_address: str
    reader_unit_id: int
    options: dict[str, Any] = field(default_factory=dict)


def build(options: EmulatorOptions, clock_ns: Callable[[], int] = time.monotonic_ns) -> Emulator:
    """Put an emulator together; its ports are open when this returns.

    Args:
        options: What to emulate.
        clock_ns: Time of the rig, the watchdogs and the faults.

    Raises:
        InputError: There is no such profile, it is not a Modbus one, has no such channels, a fault
            does not go with the link, a port is taken, or two devices have one unit id.
    """
    plan = _Plan.of(options)
    now_ns = clock_ns()
    rig = Rig(now_ns, noise=options.noise)
    log = WriteLog(options.log, time.time_ns() - now_ns)
    server = ModbusServer(options.faults, options.mute, clock_ns)
    try:
        device, reader = plan.devices(rig, log)
        if plan.apart:
            address = _serve(server, plan.link, {plan.unit: device}, options, options.port)
            reads = {plan.reader_unit: reader}
            reader_address = _serve(server, plan.reader_link, reads, options, options.reader_port)
        else:
            both = {plan.reader_unit: reader, plan.unit: device}
            address = reader_address = _serve(server, plan.link, both, options, options.port)
    except InputError:
        server.close()
        log.close()
        raise
    section = plan.section(device.wiring, address, reader_address)
    return Emulator(server, address, device, log, reader, reader_address, plan.reader_unit, section)


def _serve(
    server: ModbusServer,
    link: LinkKind,
    devices: dict[int, EmulatedDevice],
    options: EmulatorOptions,
    port: int,
) -> str:
    """Open a port for some devices and return its address."""
    wire = ModbusWire(link, devices, options.lacking)
    if link == "rtu":
        return server.open_pty(wire)
    return f"{options.host}:{server.listen_tcp(wire, options.host, port)}"


@dataclass(frozen=True, slots=True)
class _Plan:
    """Profiles, channels and places that options come to."""

    options: EmulatorOptions
    profile: ModbusProfile
    reader: ModbusProfile
    link: LinkKind
    reader_link: LinkKind
    output: str
    sensor: str
    apart: bool
    unit: int
    reader_unit: int

    @classmethod
    def of(cls, options: EmulatorOptions) -> "_Plan":
        profile = _modbus(options.profile)
        reader = profile if options.reader is None else _modbus(options.reader)
        link = options.link or profile.link.kind
        reader_link = options.link or reader.link.kind
        sensors = [name for name, each in reader.inputs.items() if each.measures == "terminal"]
        output = _chosen("output to drive the rig with", options.output, profile.outputs, profile)
        found = _chosen("input to show a displacement at", options.sensor, sensors, reader)
        line = options.reader_line or ("own" if reader.link.kind == "tcp" else "same")
        apart = reader is not profile and (line == "own" or link != reader_link)
        unit, reader_unit = profile.unit_id, _reader_unit(options, profile, reader, apart=apart)
        resets = any(fault.kind == "reset" for fault in options.faults)
        if resets and "rtu" in {link, reader_link}:
            raise InputError("fault reset is for tcp: a serial line has no connection to break")
        return cls(
            options, profile, reader, link, reader_link, output, found, apart, unit, reader_unit
        )

    def devices(self, rig: Rig, log: WriteLog) -> tuple[EmulatedDevice, EmulatedDevice]:
        """Return what drives the rig and what shows it, at one wiring."""
        channels = self.profile.outputs[self.output], self.reader.inputs[self.sensor]
        wiring = self.options.wiring or Wiring.spread(*channels)
        if self.reader is self.profile:
            device = EmulatedDevice(self.profile, rig, log, self.output, self.sensor, wiring)
            attach_stream(device, rig, log, self.output, self.sensor, noise=self.options.noise)
            return device, device
        return (
            EmulatedDevice(self.profile, rig, log, self.output, None, wiring),
            EmulatedDevice(self.reader, rig, log, None, self.sensor, wiring),
        )

    def section(self, wiring: Wiring, address: str, reader_address: str) -> dict[str, Any]:
        """Return the device section of an experiment that meets these devices."""
        output, sensor = self.profile.outputs[self.output], self.reader.inputs[self.sensor]
        made: dict[str, Any] = {
            "profile": self.options.profile,
            **_place(address),
            "output": self.output,
            "input": self.sensor,
            "sensor": {
                f"um_per_{_SUFFIX[sensor.unit]}": wiring.sensor_um,
                "offset_um": wiring.offset_um,
            },
            "watchdog": "none",
        }
        if output.unit != "A":
            gain = {f"gain_a_per_{_SUFFIX[output.unit]}": wiring.gain_a}
            made["amplifier"] = {**gain, "offset_a": wiring.offset_a}
        if self.reader is not self.profile:
            place = _place(reader_address) if self.apart else {}
            reader = {"profile": self.options.reader, "unit_id": self.reader_unit}
            made["reader"] = reader | place
        return made


def _place(address: str) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    return {"host": host, "tcp_port": int(port)} if host else {"serial_port": address}


def _modbus(name: str) -> ModbusProfile:
    profile = load_profile(name)
    if not isinstance(profile, ModbusProfile):
        raise InputError(f"{name}: only Modbus profiles can be emulated")
    return profile


def _chosen(what: str, name: str | None, known: Any, profile: ModbusProfile) -> str:
    names = list(known)
    if name in names:
        return str(name)
    if name is not None:
        raise InputError(f"{profile.title} has no {name}: {', '.join(names) or 'none'}")
    if not names:
        rest = "name a reader" if profile.outputs else "it can be another one's reader"
        raise InputError(f"{profile.title} has no {what}: {rest}")
    return str(names[0])


def _reader_unit(
    options: EmulatorOptions, profile: ModbusProfile, reader: ModbusProfile, *, apart: bool
) -> int:
    """Return the reader's unit id; on the same line it must not be the other's."""
    if apart or reader is profile:
        return reader.unit_id if options.reader_unit_id is None else options.reader_unit_id
    if options.reader_unit_id is None:
        return reader.unit_id + (reader.unit_id == profile.unit_id)
    if options.reader_unit_id == profile.unit_id:
        raise InputError(f"reader_unit_id must not be {profile.unit_id}, that of {profile.title}")
    return options.reader_unit_id
