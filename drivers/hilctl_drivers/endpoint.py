"""Addresses of the devices with the output and the sensor, resolved against their profiles."""

from dataclasses import dataclass, replace

from hilctl.base.errors import InputError
from hilctl_drivers.profile import check_baud, with_link
from hilctl_drivers.profile_base import BaseProfile, SerialLineSettings, StreamSettings
from hilctl_drivers.signal_chain import LINE, PORT, STREAM, AddressOptions, DacOptions
from hilctl_drivers.transport.port_identity import adapter_of
from hilctl_drivers.transport.resource_names import held_address, held_port
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.tcp import TcpLink, TcpStream

_OF_LINK = (*LINE, *PORT, *STREAM)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A device and its address."""

    name: str  # its profile's name in the experiment
    profile: BaseProfile  # its profile, with the experiment's settings of the line
    unit: int | None  # its address on a shared line; None if it has none
    host: str  # host name or address; empty on a serial port
    port: int | str  # TCP port, or device file of the serial port
    framing: str  # frames of Modbus, ``tcp`` or ``rtu``; empty for other protocols
    timeout_s: float  # longest wait for one answer

    @classmethod
    def of(cls, options: AddressOptions, timeout_s: float, above: str = "") -> "Endpoint":
        """Return the device at an address; raise InputError if its profile does not allow it.

        ``above`` begins the keys in messages, such as ``reader.``.
        """
        name, profile = options.profile.name, options.profile.profile
        _check_keys(options, above)
        host, framings, framing = options.host or "", profile.framings, options.framing
        if framing is None and framings:
            framing = framings[0] if host else framings[-1]
        port = options.serial_port or options.tcp_port or getattr(profile.link, "port", None)
        if port is None:
            raise InputError(f"{above}tcp_port is required: profile {name} has none")
        return cls(
            name=name,
            profile=with_link(profile, **{key: getattr(options, key) for key in _OF_LINK}),
            unit=profile.usual_unit if options.unit_id is None else options.unit_id,
            host=host,
            port=port,
            framing=framing or "",
            timeout_s=timeout_s,
        )

    @property
    def place(self) -> str:
        """``host:port``, or the serial port."""
        return f"{self.host}:{self.port}" if self.host else str(self.port)

    @property
    def holds(self) -> tuple[str, ...]:
        """Names of its address, for :attr:`hilctl.base.device.DeviceInfo.holds`."""
        if self.host:
            return held_address(self.host, int(self.port))
        return held_port(str(self.port))

    def identity(self, holds: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names for :attr:`hilctl.base.device.DeviceInfo.identity`."""
        adapter = "" if self.host else adapter_of(str(self.port))
        return (*filter(None, [adapter]), *holds[::-1])

    def link(self) -> TcpLink | StreamLink:
        """Return a new link."""
        if self.framing == "tcp":
            return TcpLink(self.host, int(self.port), self.timeout_s)
        return self._stream()

    def _stream(self) -> StreamLink:
        """Return a new link without framing."""
        line, timeout_s = self.profile.link, self.timeout_s
        assert isinstance(line, StreamSettings), "Modbus TCP has framing"
        if self.host:
            port, gap_s = int(self.port), line.silence_s
            return TcpStream(self.host, port, timeout_s, gap_s, echo=line.removes_echo)
        assert isinstance(line, SerialLineSettings)
        return SerialLink(str(self.port), line, timeout_s)


def _check_keys(options: AddressOptions, above: str) -> None:
    """Raise InputError for keys of an address that the profile does not allow."""
    name, profile = options.profile.name, options.profile.profile
    if not options.host and not isinstance(profile.link, SerialLineSettings):
        raise InputError(f"profile {name} is for TCP: give {above}host, not serial_port")
    given = [key for key in _OF_LINK if getattr(options, key) is not None]
    lacking = [f"{above}{key}" for key in given if key not in type(profile.link).model_fields]
    if lacking:
        raise InputError(f"{', '.join(lacking)} must be omitted with profile {name}")
    if options.unit_id is not None and profile.usual_unit is None:
        raise InputError(f"{above}unit_id must be omitted: {profile.title} has no address")
    if options.framing is not None and options.framing not in profile.framings:
        rule = f"{above}framing must be {' or '.join(profile.framings) or 'omitted'}"
        raise InputError(f"{rule} with profile {name}, got {options.framing}")


def reader_of(options: DacOptions, writer: Endpoint) -> Endpoint:
    """Return the device that has the input, often the same."""
    given = options.reader
    if given is None:
        return writer
    if given.host or given.serial_port:
        reader = Endpoint.of(given, options.reply_timeout_s, "reader.")
        if set(reader.holds).isdisjoint(writer.holds):
            return reader
    else:
        framed = writer.framing in given.profile.profile.framings
        framing = options.framing if framed else None
        port = int(writer.port) if writer.host else None
        where = {"host": options.host, "serial_port": options.serial_port, "tcp_port": port}
        place = given.model_copy(update={**where, "framing": framing})
        reader = Endpoint.of(place, options.reply_timeout_s, "reader.")
    return _on_the_line_of(writer, reader)


def _on_the_line_of(writer: Endpoint, reader: Endpoint) -> Endpoint:
    """Return the reader with the line settings of the output's device, whose line it shares."""
    profile, line, mine = reader.profile, writer.profile.link, reader.profile.link
    rule = f"{profile.title} cannot share the line of {writer.profile.title} at {writer.place}"
    remedy = "give reader.host or reader.serial_port, another one, if it has a link of its own"
    differ = [key for key in line.COMMON if getattr(line, key, None) != getattr(mine, key, None)]
    if type(profile) is not type(writer.profile) or reader.framing != writer.framing:
        raise InputError(f"{rule}: it has another protocol; {remedy}")
    if differ:
        raise InputError(f"{rule}: {', '.join(differ)} must be the same; {remedy}")
    if reader.unit == writer.unit:
        both = "neither has an address" if reader.unit is None else f"both are unit {reader.unit}"
        raise InputError(f"{rule}: {both}; give reader.unit_id, or {remedy}")
    if isinstance(mine, SerialLineSettings) and isinstance(line, SerialLineSettings):
        if reader.framing != "tcp":  # behind a gateway, the gateway determines the line settings
            check_baud(profile, line.baud)
        shared = {name: getattr(line, name) for name in LINE}
        profile = profile.model_copy(update={"link": mine.model_copy(update=shared)})
    return replace(writer, name=reader.name, profile=profile, unit=reader.unit)
