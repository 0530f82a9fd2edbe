"""What an experiment says of a device on a serial line, held against the device's profile."""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar

from pydantic import Field

from hilctl.errors import InputError
from hilctl.ports import DeviceOptions
from hilctl_drivers.links import SerialLink, SerialSettings
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.profile_ascii import AsciiInput, AsciiOutput, AsciiProfile
from hilctl_drivers.profile_frames import FrameChannel, FrameProfile, FrameStreaming
from hilctl_drivers.signal_chain import Amplifier, Calibration, Sensor, SignalChain
from hilctl_drivers.wire_time import exchange_time

SerialProfile: TypeAlias = AsciiProfile | FrameProfile
_Channel = TypeVar("_Channel")


class HostWatchdog(DeviceOptions):
    """What the device does by itself when this machine falls silent."""

    timeout_s: float = Field(gt=0.0, description="silence after which it acts, s")
    safe_command: float = Field(
        default=0.0, description="where it puts the output, in the command's unit"
    )


class SerialOptions(DeviceOptions):
    """Options of ``serial_dac``."""

    profile: str = Field(description="name of a shipped profile, or path of your own")
    serial_port: str = Field(description="device file; best under /dev/serial/by-id")
    baud: int | None = Field(default=None, ge=300, description="else the profile's")
    parity: Literal["N", "E", "O"] | None = Field(default=None, description="else the profile's")
    stopbits: Literal[1, 2] | None = Field(default=None, description="else the profile's")
    address: int | None = Field(
        default=None, ge=0, le=255, description="on a shared line; else the profile's"
    )
    output: str = Field(description="output that drives the actuator")
    input: str = Field(description="input that the displacement sensor is wired to")
    reader: str | None = Field(
        default=None,
        description="profile of the device that has the input, where it is another one",
    )
    reader_port: str | None = Field(
        default=None, description="its device file; left out where it is on the same line"
    )
    reader_address: int | None = Field(
        default=None, ge=0, le=255, description="its address on a shared line; else the profile's"
    )
    timeout_s: float = Field(
        default=0.1, gt=0.0, le=60.0, description="longest wait for one answer, s"
    )
    fifo_blocks: int = Field(
        default=8,
        ge=1,
        le=1024,
        description="blocks kept in the FIFO of a streaming board: what a stall of this machine"
        " may last, and by how much displacements come later",
    )
    amplifier: Amplifier | None = Field(
        default=None, description="left out only where the output is in A and drives the coil"
    )
    sensor: Sensor
    calibration: Calibration | None = None
    watchdog: HostWatchdog | Literal["none"] = Field(
        description="the device's own; none says that you know it would hold its last output"
    )


@dataclass(frozen=True, slots=True)
class SerialSetup:
    """What an experiment's options come to.

    Attributes:
        options: The options.
        profile: The profile, with the experiment's line settings in it.
        output: The output in use.
        input: The input in use.
        chain: What they are wired to.
        reader: The device that has the input, where it is another one.
    """

    options: SerialOptions
    profile: SerialProfile
    output: AsciiOutput | FrameChannel
    input: AsciiInput | FrameChannel
    chain: SignalChain
    reader: AsciiProfile | None

    @classmethod
    def of(cls, options: SerialOptions) -> "SerialSetup":
        """Load the profile and hold the options against it.

        Raises:
            InputError: They don't go together.
        """
        profile = _serial_profile(options)
        reader = _reader_profile(options, profile)
        source = reader or profile
        outputs: dict[str, Any] = dict(profile.outputs)
        inputs: dict[str, Any] = dict(source.inputs)
        output = _channel("output", options.output, outputs, profile.title)
        sensor_input = _channel("input", options.input, inputs, source.title)
        if getattr(sensor_input, "measures", "terminal") != "terminal":
            raise InputError(
                f"input {options.input} of {source.title} measures the device's own output: name "
                "the device that reads the sensor as reader"
            )
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        setup = cls(options, profile, output, sensor_input, chain, reader)
        setup.check_watchdog()
        return setup

    def check_watchdog(self) -> None:
        """Refuse a watchdog that the device hasn't got, or with values that it can't take."""
        wanted, has = self.options.watchdog, self.profile.watchdog
        if wanted == "none":
            return
        if has == "none":
            raise InputError(
                f"{self.profile.title} has no host watchdog: it holds its last output when this "
                "machine dies; say watchdog: none if you accept that"
            )
        has.counts(wanted.timeout_s)
        low, high = self.command_range
        if not low <= wanted.safe_command <= high:
            raise InputError(
                f"watchdog.safe_command must be {low:g} to {high:g}, got {wanted.safe_command:g}"
            )

    @property
    def output_range(self) -> tuple[float, float]:
        """Lowest and highest value of the output, in its own unit."""
        return _limits(self.output)

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command."""
        return self.chain.command_range(*self.output_range)

    @property
    def displacement_range(self) -> tuple[float, float]:
        """Lowest and highest displacement that the input can show, um."""
        return self.chain.displacement_range(*_limits(self.input))

    @property
    def streaming(self) -> FrameStreaming | None:
        """The board's FIFO, where it is used."""
        found = getattr(self.profile, "streaming", "none")
        return found if isinstance(found, FrameStreaming) else None

    @property
    def address(self) -> int:
        """The device's address on a shared line; 0 where there is none."""
        if self.options.address is not None:
            return self.options.address
        shipped = getattr(self.profile, "address", "none")
        return shipped if isinstance(shipped, int) else 0

    @property
    def reader_address(self) -> int:
        """The reader's address on a shared line; 0 where there is none."""
        if self.options.reader_address is not None:
            return self.options.reader_address
        shipped = "none" if self.reader is None else self.reader.address
        return shipped if isinstance(shipped, int) else 0

    @property
    def watchdog_timeout_s(self) -> float | None:
        """The timeout that the experiment wants, s; None without a watchdog."""
        wanted = self.options.watchdog
        return None if wanted == "none" else wanted.timeout_s

    @property
    def safe_output(self) -> float:
        """Output value that the watchdog is to go to."""
        wanted = self.options.watchdog
        return self.chain.output(0.0 if wanted == "none" else wanted.safe_command)

    def rate(self, block: int) -> tuple[float, str]:
        """Return the highest sample rate that wire and device leave, Hz, and why it is that.

        Args:
            block: Samples in an exchange.
        """
        options, profile = self.options, self.profile
        own_input = options.input if self.reader is None else None
        time = exchange_time(profile, options.output, own_input, block=block)
        total_s, note, limit_hz = time.total_s, str(time), profile.max_rate_hz
        if self.reader is not None:
            read_s = self._reader_time_s(self.reader)
            total_s += read_s
            limit_hz = min(limit_hz, self.reader.max_rate_hz)
            note += f"; {self.reader.title} {read_s * 1e3:.2f} ms"
        return min(block / total_s, limit_hz), f"{note}; {profile.title} at most {limit_hz:g} Hz"

    def _reader_time_s(self, reader: AsciiProfile) -> float:
        """Return how long the reader takes to be asked and to answer, s."""
        assert isinstance(self.input, AsciiInput)
        line = reader.link if self.options.reader_port else self.profile.link
        ask = self.input.ask.format(address=self.reader_address)
        ends = len(reader.link.terminator) + len(reader.link.reply_terminator)
        characters = len(ask) + len(self.input.example) + ends
        return characters * line.char_s + reader.link.min_gap_s + reader.turnaround_s

    def details(self) -> dict[str, str]:
        """Return what is worth keeping with a recording, as text."""
        profile, options = self.profile, self.options
        kept = options.model_dump(exclude_none=True)
        found = {
            "vendor": profile.vendor,
            "model": profile.model,
            "source": "; ".join(profile.source),
            "verified": profile.verified,
            "link": profile.link.model_dump_json(),
            **{name: str(value) for name, value in kept.items()},
        }
        if self.streaming is not None:
            found["fifo_depth"] = f"{self.streaming.fifo_depth} samples"
            found["fifo_level"] = f"{options.fifo_blocks} blocks"
        return found

    def link(self, extra_s: float = 0.0) -> SerialLink:
        """Return a new link to the device.

        Args:
            extra_s: Time that an answer takes by design, on top of the time-out.
        """
        timeout_s = self.options.timeout_s + extra_s
        return SerialLink(self.options.serial_port, _settings(self.profile), timeout_s)

    def reader_link(self) -> SerialLink:
        """Return a new link to the reader, which has a port of its own."""
        assert self.reader is not None
        assert self.options.reader_port is not None
        return SerialLink(self.options.reader_port, _settings(self.reader), self.options.timeout_s)


def _settings(profile: SerialProfile) -> SerialSettings:
    link = profile.link
    gap_s = link.min_gap_s if link.kind == "ascii" else 0.0
    return SerialSettings(
        link.baud, link.bytesize, link.parity, link.stopbits, gap_s, link.boot_wait_s
    )


def _serial_profile(options: SerialOptions) -> SerialProfile:
    profile = load_profile(options.profile)
    if not isinstance(profile, AsciiProfile | FrameProfile):
        raise InputError(f"profile {options.profile} is one of a Modbus device: use modbus_dac")
    given = {"baud": options.baud, "parity": options.parity, "stopbits": options.stopbits}
    changes = {key: value for key, value in given.items() if value is not None}
    changed = with_link(profile, **changes) if changes else profile
    assert isinstance(changed, AsciiProfile | FrameProfile)
    return changed


def _reader_profile(options: SerialOptions, profile: SerialProfile) -> AsciiProfile | None:
    """Return the profile of the device that has the input; None where it is the same device."""
    if options.reader is None:
        if options.reader_port is not None or options.reader_address is not None:
            raise InputError("reader_port and reader_address go with reader")
        return None
    reader = load_profile(options.reader)
    if not isinstance(reader, AsciiProfile) or not isinstance(profile, AsciiProfile):
        raise InputError("reader is for devices that speak lines of text, both of them")
    if options.reader_port is not None:
        return reader
    ours, theirs = profile.link, reader.link
    kept = ("terminator", "reply_terminator", "checksum", "bytesize", "echo")
    if any(getattr(ours, name) != getattr(theirs, name) for name in kept):
        rule = f"{reader.title} can't share the line of {profile.title}: {', '.join(kept)} differ"
        raise InputError(f"{rule}; give reader_port")
    return reader


def _limits(channel: AsciiOutput | AsciiInput | FrameChannel) -> tuple[float, float]:
    if isinstance(channel, FrameChannel):
        return channel.limits
    return channel.min, channel.max


def _channel(what: str, name: str, channels: dict[str, _Channel], title: str) -> _Channel:
    if name in channels:
        return channels[name]
    known = ", ".join(channels) or "none"
    raise InputError(f"{what} must be one that {title} has, got {name!r} (it has {known})")
