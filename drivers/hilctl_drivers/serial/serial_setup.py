"""What an experiment says of a device on a serial line, held against the device's profile."""

from dataclasses import dataclass

from pydantic import Field

from hilctl.base.errors import InputError
from hilctl_drivers.profile import NamedProfile, check_baud, with_link
from hilctl_drivers.profile_base import BaseProfile, Range
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, SignalChain, channel, check_watchdog
from hilctl_drivers.transport.link_config import SerialLineSettings
from hilctl_drivers.transport.resource_names import held_port
from hilctl_drivers.transport.serial_port import SerialLink

_LINE = ("baud", "parity", "stopbits")
"""Settings of a line that the experiment may change, for all devices on it."""


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    serial_port: str = Field(description="device file; best under /dev/serial/by-id")
    measure: str | None = Field(
        default=None,
        description="input that measures the output itself, recorded beside the command; it costs"
        " one more question a sample",
    )
    fifo_blocks: FifoBlocks = 8


@dataclass(frozen=True, slots=True)
class SerialSetup:
    """What an experiment's options come to.

    Attributes:
        options: The options.
        profile: The profile, with the experiment's line settings in it.
        reader: The same of the device that has the input; ``profile`` itself where it has that.
        output: The output in use.
        input: The input in use.
        chain: What they are wired to.
    """

    options: SerialOptions
    profile: BaseProfile
    reader: BaseProfile
    output: Range
    input: Range
    chain: SignalChain

    @classmethod
    def of(cls, options: SerialOptions) -> "SerialSetup":
        """Hold options against their profiles.

        Raises:
            InputError: They don't go together.
        """
        profile = with_link(
            _serial_profile(options.profile),
            baud=options.baud,
            parity=options.parity,
            stopbits=options.stopbits,
        )
        reader = _reader(options, profile)
        output = channel("output", options.output, profile.outputs, profile.title)
        sensor_input = channel("input", options.input, reader.inputs, reader.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        check_watchdog(profile.title, options, output, chain, profile.watchdog)
        return cls(options, profile, reader, output, sensor_input, chain)

    @property
    def reads_elsewhere(self) -> bool:
        """Whether another device has the input."""
        return self.reader is not self.profile

    @property
    def title(self) -> str:
        """The device in messages."""
        return f"serial_dac {self.options.profile.name} at {self.options.serial_port}"

    @property
    def holds(self) -> tuple[str, ...]:
        """Its ports as :attr:`hilctl.base.device.DeviceInfo.holds` has them."""
        reader = self.options.reader
        ports = (self.options.serial_port, reader.serial_port if reader else None)
        held = [name for port in ports if port is not None for name in held_port(port)]
        return tuple(dict.fromkeys(held))

    def details(self) -> dict[str, str]:
        """Return what is worth keeping with a recording, as text."""
        found = {**self.profile.provenance(), "link": self.profile.link.model_dump_json()}
        found |= self.options.details()
        return found | (self.reader.provenance("reader_") if self.reads_elsewhere else {})

    def link(self, extra_s: float = 0.0) -> SerialLink:
        """Return a new link to the device.

        Args:
            extra_s: Time that an answer takes by design, on top of the time-out.
        """
        timeout_s = self.options.timeout_s + extra_s
        return SerialLink(self.options.serial_port, _line(self.profile).settings, timeout_s)

    def reader_link(self, shared: SerialLink) -> SerialLink:
        """Return a new link to the reader, or the shared one where it is on the same line."""
        reader = self.options.reader
        if reader is None or reader.serial_port is None:
            return shared
        return SerialLink(reader.serial_port, _line(self.reader).settings, self.options.timeout_s)


def _line(profile: BaseProfile) -> SerialLineSettings:
    assert isinstance(profile.link, SerialLineSettings), "only such profiles have a WIRE"
    return profile.link


def _serial_profile(named: NamedProfile) -> BaseProfile:
    profile = named.profile
    if not profile.WIRE:
        raise InputError(f"profile {named.name} is one for kind: {profile.DEVICE}, not serial_dac")
    return profile


def _reader(options: SerialOptions, profile: BaseProfile) -> BaseProfile:
    """Return the profile of the device that has the input, often the same.

    On the other's line it is set as that one is, if it can be.
    """
    given = options.reader
    if given is None:
        return profile
    reader = _serial_profile(given.profile)
    if given.serial_port is not None:
        return with_link(reader, baud=given.baud)
    line = _line(profile)
    check_baud(reader, line.baud)
    shared = {name: getattr(line, name) for name in _LINE}
    return reader.model_copy(update={"link": reader.link.model_copy(update=shared)})
