"""One device on Modbus and how it is reached: TCP, a gateway, or a serial line."""

from dataclasses import dataclass, replace
from typing import Literal, cast

from hilctl.base.errors import InputError
from hilctl_drivers.device import held_address, held_port, line_settings
from hilctl_drivers.modbus.options import ModbusOptions
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.wire.line_settings import RtuLink
from hilctl_drivers.wire.links import Link
from hilctl_drivers.wire.serial_port import SerialLink
from hilctl_drivers.wire.tcp import TcpLink

_TCP_PORT = 502


@dataclass(frozen=True, slots=True)
class ModbusPeer:
    """A device and its place.

    Attributes:
        name: Its profile's name, as the experiment has it.
        profile: What it is, with the experiment's line settings in it.
        unit: Its unit id.
        host: Where it is on the network; empty on a serial port.
        port: TCP port there, or device file of the serial port.
        timeout_s: Longest wait for one answer.
    """

    name: str
    profile: ModbusProfile
    unit: int
    host: str
    port: int | str
    timeout_s: float

    @property
    def place(self) -> str:
        """Where it is: ``host:port`` or the serial port."""
        return f"{self.host}:{self.port}" if self.host else str(self.port)

    @property
    def holds(self) -> str:
        """Its place as :attr:`hilctl.base.device.DeviceInfo.holds` has it."""
        if self.host:
            return held_address(self.host, int(self.port))
        return held_port(str(self.port))

    def link(self) -> Link:
        """Return a new link to it."""
        if self.host:
            return TcpLink(self.host, int(self.port), self.timeout_s)
        assert isinstance(self.profile.link, RtuLink)
        return SerialLink(str(self.port), line_settings(self.profile.link), self.timeout_s)

    def session(self, link: Link | None = None) -> ModbusSession:
        """Return a session, on a link that it shares with others or on a new one."""
        framing: Literal["tcp", "rtu"] = "tcp" if self.host else "rtu"
        return ModbusSession(self.profile, link or self.link(), self.unit, framing=framing)


def writer_of(options: ModbusOptions) -> ModbusPeer:
    """Return the device that has the output.

    Raises:
        InputError: There is no such profile, or it does not go with the place.
    """
    profile = _profile(options.profile, options.serial_port, "host")
    given = {"baud": options.baud, "parity": options.parity, "stopbits": options.stopbits}
    changes = {key: value for key, value in given.items() if value is not None}
    if changes and not isinstance(profile.link, RtuLink):
        raise InputError(f"{', '.join(changes)} must be left out: {profile.title} has no line")
    unit = profile.unit_id if options.unit_id is None else options.unit_id
    return _peer(
        options,
        options.profile,
        _on_line(profile, **changes),
        unit,
        (options.host, options.port, options.serial_port),
    )


def reader_of(options: ModbusOptions, writer: ModbusPeer) -> ModbusPeer:
    """Return the device that has the input, often the same.

    Raises:
        InputError: There is no such profile, it does not go with the place, or two devices of one
            line have one unit id.
    """
    if options.reader is None:
        return writer
    alone = options.reader_host or options.reader_serial_port
    serial_port = options.reader_serial_port if alone else options.serial_port
    profile = _profile(options.reader, serial_port, "reader_host")
    unit = profile.unit_id if options.reader_unit_id is None else options.reader_unit_id
    if alone:
        baud = {} if options.reader_baud is None else {"baud": options.reader_baud}
        place = (options.reader_host, options.reader_tcp_port, options.reader_serial_port)
        reader = _peer(options, options.reader, _on_line(profile, **baud), unit, place)
        if reader.holds != writer.holds:
            return reader
    if unit == writer.unit:
        raise InputError(
            f"{profile.title} and {writer.profile.title} can't both be unit {unit} at "
            f"{writer.place}: give reader_unit_id, or reader_host or reader_serial_port where it "
            "has a place of its own"
        )
    if isinstance(profile.link, RtuLink) and isinstance(writer.profile.link, RtuLink):
        profile = profile.model_copy(update={"link": writer.profile.link})  # one line, one baud
    return replace(writer, name=options.reader, profile=profile, unit=unit)


def _profile(name: str, serial_port: str | None, other: str) -> ModbusProfile:
    profile = load_profile(name)
    if not isinstance(profile, ModbusProfile):
        raise InputError(f"profile {name} is not one of a Modbus device")
    if profile.link.kind == "tcp" and serial_port is not None:
        raise InputError(f"profile {name} is for Modbus tcp: give {other}")
    return profile


def _on_line(profile: ModbusProfile, **changes: object) -> ModbusProfile:
    return cast(ModbusProfile, with_link(profile, **changes)) if changes else profile


def _peer(
    options: ModbusOptions,
    name: str,
    profile: ModbusProfile,
    unit: int,
    place: tuple[str | None, int | None, str | None],
) -> ModbusPeer:
    host, tcp_port, serial_port = place
    if host is None:
        assert serial_port is not None
        return ModbusPeer(name, profile, unit, "", serial_port, options.timeout_s)
    usual = profile.link.port if profile.link.kind == "tcp" else _TCP_PORT
    return ModbusPeer(name, profile, unit, host, tcp_port or usual, options.timeout_s)
