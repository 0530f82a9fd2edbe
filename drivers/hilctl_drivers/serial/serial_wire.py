"""An experiment's options for a serial line, and what a protocol implements for ``serial_dac``."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from pydantic import Field

from hilctl.base.errors import InputError
from hilctl.base.types import F64
from hilctl_drivers.profile import NamedProfile, check_baud, with_link
from hilctl_drivers.profile_base import BaseProfile, Range, SerialLineSettings
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, SignalChain, channel, check_watchdog
from hilctl_drivers.transport.resource_names import held_port
from hilctl_drivers.transport.safe_exchange import SafeExchange, check_read_back
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.wire_time import RateLimit

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


class SerialWire(ABC):
    """How one kind of device is talked to; values are in the units of its channels.

    Attributes:
        block_max: Most samples of one exchange.
        fifo_depth: Samples that its FIFO holds; 0 where it has none.
        measures: Whether :meth:`exchange` fills ``measured``.
        longest_message_s: Longest until the safe value is there, after an exchange that is under
            way; 0 where that is too short to be worth a word.
        arm_s: Longest that :meth:`arm` takes on the wire.
        unconfirmed: Why a value that was written cannot be confirmed, in words; empty if it can.

    Args:
        setup: What the experiment says of it.

    Raises:
        InputError: Options that this protocol has no use for.
    """

    block_max = 1
    fifo_depth = 0
    measures = False
    longest_message_s = 0.0
    unconfirmed = ""
    arm_s = 0.0

    def __init__(self, setup: SerialSetup) -> None:
        self._setup = setup
        self._link = setup.link()
        self._safe_exchange = SafeExchange()

    @abstractmethod
    def rates(self, block: int) -> RateLimit:
        """Return the sample rates that wire and device leave with this block."""

    @abstractmethod
    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check and set up; the output does not move.

        Raises:
            DeviceError: It can't be reached, is another device, or can't keep this rate or block.
        """

    @abstractmethod
    def arm(self) -> None:
        """Arm the watchdog, if the experiment wants it; the output does not move.

        Raises:
            DeviceError: The device did not confirm.
        """

    @abstractmethod
    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """Send float64[B], fill ``reading`` (float64[B]), see :class:`~hilctl.base.device.Device`.

        ``measured``, float64[B] in the output's unit, is filled where :attr:`measures` says so.

        Raises:
            DeviceError: No good answer in time.
        """

    def put_out(self, value: float) -> None:
        """Put ``value`` out at once in one attempt, by the open link or by a new one.

        Raises:
            UnconfirmedError: It was sent, and nothing that the device answers would confirm it.
            DeviceError: It was not confirmed.
        """
        self._safe_exchange.attempt(
            self._link, lambda: self._send(value), lambda: self._put_out(value)
        )

    def doubt(self) -> None:
        """Take no later answer for that to a message which failed."""
        self._link.doubt()

    @abstractmethod
    def output(self) -> float | None:
        """Return what the open device puts out, in the output's unit; None where it can't tell.

        Raises:
            DeviceError: No good answer in time.
        """

    @abstractmethod
    def look(self) -> tuple[float, float | None]:
        """Connect and return the input's value and the output's, None where it can't be known.

        Nothing is sent that changes anything: no steps of the profile, no watchdog, no clearing of
        a trip. :meth:`release` follows.

        Raises:
            DeviceError: It can't be reached, is another device, or gives no good answer.
        """

    @abstractmethod
    def _send(self, value: float) -> None:
        """Send ``value`` to the output and await no answer."""

    @abstractmethod
    def _put_out(self, value: float) -> None:
        """Put ``value`` out, and raise unless the device confirms it."""

    def _check_read_back(self, wanted: float, found: float) -> None:
        """Refuse a value read back that is not the one written, within two steps."""
        output = self._setup.output
        step = output.resolution or 1e-3 * (output.max - output.min)
        check_read_back(output, wanted, found, 2.0 * step)

    @abstractmethod
    def close(self) -> None:
        """Disarm and carry out the close steps; :meth:`release` follows.

        Raises:
            DeviceError: The device did not confirm.
        """

    @abstractmethod
    def release(self) -> None:
        """Let go of the port and say nothing to the device."""
