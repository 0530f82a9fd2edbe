"""Options of a Modbus device, resolved against its profile."""

from dataclasses import dataclass, replace
from typing import Annotated, Self, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import InputError
from hilctl_drivers.modbus.modbus_profile import (
    ModbusInput,
    ModbusOutput,
    ModbusProfile,
    ModbusRtuLink,
)
from hilctl_drivers.modbus.modbus_session import (
    ModbusSession,
    arm_s,
    exchange_time,
    feed_time,
    read_time,
)
from hilctl_drivers.profile import NamedProfile, check_baud, with_link
from hilctl_drivers.signal_chain import (
    DacOptions,
    ReaderOptions,
    SignalChain,
    channel,
    check_watchdog,
)
from hilctl_drivers.transport.links import Link
from hilctl_drivers.transport.resource_names import held_address, held_port
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.tcp import TcpLink
from hilctl_drivers.transport.wire_time import RateLimit, WireTime

_TCP_PORT = 502


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    if not host.strip():
        raise ValueError("must be a name or an address, got an empty text")
    if colon and ":" not in name and port.isdecimal():
        raise ValueError(f"must have no port: set host to {name} and tcp_port to {port}")
    return host


HostName: TypeAlias = Annotated[str, AfterValidator(_without_port)]


class ModbusReaderOptions(ReaderOptions):
    """The device with the input, if it is another one."""

    host: HostName | None = Field(
        default=None, description="host name or address; omitted if on the same connection"
    )
    tcp_port: int | None = Field(
        default=None, ge=1, le=65535, description="TCP port; default: the profile's, or 502"
    )

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if self.host is not None and self.serial_port is not None:
            raise ValueError("must have one of host and serial_port, or none")
        if self.host is None and self.tcp_port is not None:
            raise ValueError("tcp_port goes with host")
        return self


class ModbusOptions(DacOptions):
    """Options of ``modbus_dac``."""

    host: HostName | None = Field(
        default=None, description="host name or address, for Modbus TCP or a gateway to Modbus RTU"
    )
    tcp_port: int | None = Field(
        default=None, ge=1, le=65535, description="TCP port; default: the profile's, or 502"
    )
    reader: ModbusReaderOptions | None = Field(
        default=None, description="device with the input, if it is another one"
    )

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.host is None) == (self.serial_port is None):
            raise ValueError("must have either host or serial_port")
        if self.host is None and self.tcp_port is not None:
            raise ValueError("tcp_port goes with host")
        return self


@dataclass(frozen=True, slots=True)
class ModbusEndpoint:
    """A device and its place: TCP, a gateway, or a serial line.

    Attributes:
        name: Its profile's name in the experiment.
        profile: Its profile, with the experiment's line settings.
        unit: Its unit id.
        host: Host name or address; empty on a serial port.
        port: TCP port, or device file of the serial port.
        timeout_s: Longest wait for one answer.
    """

    name: str
    profile: ModbusProfile
    unit: int
    host: str
    port: int | str
    timeout_s: float

    @classmethod
    def of(
        cls, options: ModbusOptions | ModbusReaderOptions, profile: ModbusProfile, timeout_s: float
    ) -> "ModbusEndpoint":
        """Return the device at the place in the options."""
        usual = getattr(profile.link, "port", _TCP_PORT)
        unit = profile.unit_id if options.unit_id is None else options.unit_id
        port = options.serial_port or options.tcp_port or usual
        return cls(options.profile.name, profile, unit, options.host or "", port, timeout_s)

    @property
    def place(self) -> str:
        """``host:port``, or the serial port."""
        return f"{self.host}:{self.port}" if self.host else str(self.port)

    @property
    def holds(self) -> tuple[str, ...]:
        """Names of its place, for :attr:`hilctl.base.device.DeviceInfo.holds`."""
        if self.host:
            return held_address(self.host, int(self.port))
        return held_port(str(self.port))

    def reached(self, link: Link) -> "ModbusEndpoint":
        """Return this with the numeric address of an open link, so no name is looked up again."""
        return replace(self, host=link.peer_host) if isinstance(link, TcpLink) else self

    def session(self, link: Link | None = None) -> ModbusSession:
        """Return a session, on a link that it shares with others or on a new one."""
        if self.host:
            link = link or TcpLink(self.host, int(self.port), self.timeout_s)
            return ModbusSession(self.profile, link, self.unit, framing="tcp")
        assert isinstance(self.profile.link, ModbusRtuLink)
        link = link or SerialLink(str(self.port), self.profile.link.settings, self.timeout_s)
        return ModbusSession(self.profile, link, self.unit, framing="rtu")


@dataclass(frozen=True, slots=True)
class ModbusSetup:
    """An experiment's options, resolved against the profiles.

    Attributes:
        options: The options.
        writer: The device that has the output.
        reader: The device that has the input; the same object if it is the same device.
        output: The output in use.
        input: The input in use.
        chain: Amplifier and sensor.
    """

    options: ModbusOptions
    writer: ModbusEndpoint
    reader: ModbusEndpoint
    output: ModbusOutput
    input: ModbusInput
    chain: SignalChain

    @classmethod
    def of(cls, options: ModbusOptions) -> "ModbusSetup":
        """Resolve options, or raise InputError if they do not fit their profiles."""
        writer = _writer_of(options)
        reader = _reader_of(options, writer)
        there, here = reader.profile, writer.profile
        output = channel("output", options.output, here.outputs, here.title)
        sensor_input = channel("input", options.input, there.inputs, there.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        setup = cls(options, writer, reader, output, sensor_input, chain)
        wire = setup.wire(setup.may_combine)
        if options.timeout_s <= wire.answered_s:
            raise InputError(
                f"timeout_s must be > {wire.answered_s:g}, got {options.timeout_s:g} ({wire})"
            )
        check_watchdog(here.title, options, output, chain, here.watchdog)
        return setup

    @property
    def reads_elsewhere(self) -> bool:
        """Whether another device has the input."""
        return self.reader is not self.writer

    @property
    def shares_link(self) -> bool:
        """Whether both devices are on one line or connection."""
        return not set(self.reader.holds).isdisjoint(self.writer.holds)

    @property
    def may_combine(self) -> bool:
        """Whether a sample may be one transaction; :meth:`ModbusDac.open` finds out.

        Trying it moves an output that cannot be read back, so it is not tried there.
        """
        if self.reads_elsewhere:
            return False
        return self.writer.profile.exchange != "none" and self.output.readback_register is not None

    @property
    def unconfirmed(self) -> str:
        """Why a value that was written cannot be confirmed, as text; empty if it can."""
        output = self.output
        if output.readback_register is not None or output.function != 6 or self.writer.host:
            return ""
        # The correct reply equals the request, and is what a line that echoes gives.
        return (
            "the device cannot confirm it: on a serial line the reply to function 6 may be an echo,"
            " and the output cannot be read back"
        )

    def wire(self, one_transaction: bool) -> WireTime:
        """Return the time of a sample on the wire."""
        profile, name = self.writer.profile, self.options.output
        if not self.reads_elsewhere:
            return exchange_time(profile, name, self.options.input, one_transaction=one_transaction)
        wire = read_time(self.reader.profile, self.input).then(exchange_time(profile, name, None))
        if self.shares_link:
            return wire
        # Of two lines, one is silent before its next request while the other is at work.
        return replace(wire, gaps=wire.gaps // 2, gaps_s=0.5 * wire.gaps_s)

    def rates(self, one_transaction: bool) -> RateLimit:
        """Return the sample rates that wire and devices allow."""
        wire = self.wire(one_transaction)
        if self.options.watchdog != "none":
            wire = wire.then(feed_time(self.writer.profile))
        slowest = min((self.writer, self.reader), key=lambda peer: peer.profile.max_rate_hz)
        whose = f"profile {slowest.name}" if self.reads_elsewhere else "its profile"
        return RateLimit.of(wire, slowest.profile.max_rate_hz, whose)

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        options, writer, reader = self.options, self.writer, self.reader
        description = f"{writer.profile.title} at {writer.place}: {options.output}"
        details = {**writer.profile.provenance(), "link": writer.profile.link.model_dump_json()}
        details |= options.details()
        if self.reads_elsewhere:
            description += f"; {reader.profile.title}, unit {reader.unit} at {reader.place}: "
            details |= reader.profile.provenance("reader_")
        else:
            description += ", "
        return self.chain.info(
            "modbus_dac",
            options,
            self.rates(self.may_combine),
            description=description + options.input,
            holds=tuple(dict.fromkeys(writer.holds + reader.holds)),
            arm_s=0.0 if options.watchdog == "none" else arm_s(writer.profile, options.output),
            confirms=not self.unconfirmed,
            safe_note=self.unconfirmed,
            details=details,
        )


def _writer_of(options: ModbusOptions) -> ModbusEndpoint:
    profile = _modbus_profile(options.profile, options.serial_port, "host")
    changes = {key: getattr(options, key) for key in ("baud", "parity", "stopbits")}
    given = [key for key, value in changes.items() if value is not None]
    if given and not isinstance(profile.link, ModbusRtuLink):
        raise InputError(f"{', '.join(given)} must be omitted: {profile.title} has no line")
    return ModbusEndpoint.of(options, with_link(profile, **changes), options.timeout_s)


def _reader_of(options: ModbusOptions, writer: ModbusEndpoint) -> ModbusEndpoint:
    """Return the device that has the input, often the same."""
    given = options.reader
    if given is None:
        return writer
    alone = given.host or given.serial_port
    serial_port = given.serial_port if alone else options.serial_port
    profile = _modbus_profile(given.profile, serial_port, "reader.host")
    reader = ModbusEndpoint.of(given, profile, options.timeout_s)
    if alone:
        reader = replace(reader, profile=with_link(profile, baud=given.baud))
        if set(reader.holds).isdisjoint(writer.holds):
            return reader
    if reader.unit == writer.unit:
        raise InputError(
            f"{profile.title} and {writer.profile.title} can't both be unit {writer.unit} at "
            f"{writer.place}: give reader.unit_id, or reader.host or reader.serial_port where it "
            "has a place of its own"
        )
    line = writer.profile.link
    if isinstance(profile.link, ModbusRtuLink) and isinstance(line, ModbusRtuLink):
        if not writer.host:  # behind a gateway the line is the gateway's business
            check_baud(profile, line.baud)
        profile = profile.model_copy(update={"link": line})
    return replace(writer, name=reader.name, profile=profile, unit=reader.unit)


def _modbus_profile(named: NamedProfile, serial_port: str | None, other: str) -> ModbusProfile:
    profile = named.profile
    if not isinstance(profile, ModbusProfile):
        raise InputError(f"profile {named.name} is not one of a Modbus device")
    if profile.link.kind == "tcp" and serial_port is not None:
        raise InputError(f"profile {named.name} is for Modbus tcp: give {other}")
    return profile
