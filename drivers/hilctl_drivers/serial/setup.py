"""What an experiment says of a device on a serial line, held against the device's profile."""

from dataclasses import dataclass
from typing import Any, TypeAlias

from hilctl.base.errors import InputError
from hilctl_drivers.board.profile import FrameChannel, FrameProfile, FrameStreaming
from hilctl_drivers.device import (
    channel,
    check_senses,
    check_watchdog,
    details,
    held_port,
    line_settings,
    provenance,
)
from hilctl_drivers.feed_time import feed_time
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.serial.options import SerialOptions
from hilctl_drivers.text.profile import AsciiInput, AsciiOutput, AsciiProfile
from hilctl_drivers.text.queries import measuring_input, query_time_s
from hilctl_drivers.wire.serial_port import SerialLink
from hilctl_drivers.wire_time import exchange_time
from hilctl_drivers.wiring import SignalChain

SerialProfile: TypeAlias = AsciiProfile | FrameProfile


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
        measure: The input that measures the output, where it is to be asked.
    """

    options: SerialOptions
    profile: SerialProfile
    output: AsciiOutput | FrameChannel
    input: AsciiInput | FrameChannel
    chain: SignalChain
    reader: AsciiProfile | None
    measure: AsciiInput | None = None

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
        output = channel("output", options.output, outputs, profile.title)
        sensor_input = channel("input", options.input, inputs, source.title)
        check_senses(options.input, sensor_input, source.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        measure = measuring_input(profile, options.measure, output)
        setup = cls(options, profile, output, sensor_input, chain, reader, measure)
        check_watchdog(
            profile.title, options.output, output, chain, options.watchdog, profile.watchdog
        )
        return setup

    @property
    def output_range(self) -> tuple[float, float]:
        """Lowest and highest value of the output, in its own unit."""
        return self.output.min, self.output.max

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command."""
        return self.chain.command_range(*self.output_range)

    @property
    def displacement_range(self) -> tuple[float, float]:
        """Lowest and highest displacement that the input can show, um."""
        return self.chain.displacement_range(self.input.min, self.input.max)

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
        if self.measure is not None and isinstance(profile, AsciiProfile):
            measure_s = query_time_s(profile, profile.link, self.measure, self.address)
            total_s += measure_s
            note += f"; measuring {options.measure} {measure_s * 1e3:.2f} ms"
        feed = feed_time(profile) if options.watchdog != "none" else None
        if feed is not None:
            total_s += feed.total_s
            note += f"; feeding the watchdog {feed.total_s * 1e3:.2f} ms"
        return min(block / total_s, limit_hz), f"{note}; {profile.title} at most {limit_hz:g} Hz"

    def _reader_time_s(self, reader: AsciiProfile) -> float:
        """Return how long the reader takes to be asked and to answer, s."""
        assert isinstance(self.input, AsciiInput)
        line = reader.link if self.options.reader_port else self.profile.link
        assert line.kind == "ascii"
        return query_time_s(reader, line, self.input, self.reader_address)

    def details(self) -> dict[str, str]:
        """Return what is worth keeping with a recording, as text."""
        found = details(self.profile, self.profile.link.model_dump_json(), self.options)
        if self.reader is not None:
            found |= provenance(self.reader, "reader_")
        if self.streaming is not None:
            found["fifo_depth"] = f"{self.streaming.fifo_depth} samples"
            found["fifo_level"] = f"{self.options.fifo_blocks} blocks"
        return found

    @property
    def holds(self) -> tuple[str, ...]:
        """Its ports as :attr:`hilctl.base.device.DeviceInfo.holds` has them."""
        ports = (self.options.serial_port, self.options.reader_port)
        return tuple(dict.fromkeys(held_port(port) for port in ports if port is not None))

    def link(self, extra_s: float = 0.0) -> SerialLink:
        """Return a new link to the device.

        Args:
            extra_s: Time that an answer takes by design, on top of the time-out.
        """
        timeout_s = self.options.timeout_s + extra_s
        return SerialLink(self.options.serial_port, line_settings(self.profile.link), timeout_s)

    def reader_link(self) -> SerialLink:
        """Return a new link to the reader, which has a port of its own."""
        assert self.reader is not None
        assert self.options.reader_port is not None
        return SerialLink(
            self.options.reader_port, line_settings(self.reader.link), self.options.timeout_s
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
