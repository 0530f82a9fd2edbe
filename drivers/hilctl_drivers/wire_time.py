"""How long one exchange takes on the wire, and the highest rate that leaves.

What is counted can't be beaten: characters at the line's baud, gaps that the protocol or the device
asks for, USB frames, and the device's turnaround. What the operating system adds is not counted, so
a rate that is refused here is impossible, and one that is not may still be out of reach.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from hilctl_drivers.board.frames import exchange_sizes
from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_pdu,
    reply_size,
    rtu_adu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.text.profile import AsciiProfile
from hilctl_drivers.wire.framing import binary_framing
from hilctl_drivers.wire.line_settings import FramesLink, RtuLink

Profile: TypeAlias = ModbusProfile | AsciiProfile | FrameProfile
Line: TypeAlias = tuple[str, str | None]
"""What is sent, and an example of its reply; None where it is not answered."""

CHECKSUM_CHARS = {"none": 0, "dcon": 2, "gen": 3}
"""Characters that a line's checksum adds."""
_USB_BITS_PER_S = {True: 19 * 64 * 8e3, False: 13 * 512 * 8 * 8e3}
"""Bulk payload of full-speed (1 ms) and high-speed (125 us) frames (USB 2.0, tables 5-9, 5-10)."""


@dataclass(frozen=True, slots=True)
class WireTime:
    """What an exchange costs.

    Attributes:
        what: Requests and line, like ``FC23 at 115200 8N1``.
        request_s: Characters of all requests.
        reply_s: Characters of all replies.
        gaps: Number of gaps.
        gaps_s: All gaps together.
        turnaround_s: The device's, all requests together.
        samples: Samples that one exchange carries.
    """

    what: str
    request_s: float
    reply_s: float
    gaps: int
    gaps_s: float
    turnaround_s: float
    samples: int = 1

    @property
    def total_s(self) -> float:
        """Time of one exchange, s."""
        return self.request_s + self.reply_s + self.gaps_s + self.turnaround_s

    @property
    def highest_rate_hz(self) -> float:
        """Highest sample rate that the wire and the device leave."""
        return self.samples / self.total_s if self.total_s > 0.0 else float("inf")

    def then(self, other: "WireTime") -> "WireTime":
        """Return what this and then ``other`` cost, for the samples of this."""
        return WireTime(
            f"{self.what}, then {other.what}",
            self.request_s + other.request_s,
            self.reply_s + other.reply_s,
            self.gaps + other.gaps,
            self.gaps_s + other.gaps_s,
            self.turnaround_s + other.turnaround_s,
            self.samples,
        )

    def __str__(self) -> str:
        parts = []
        if self.request_s > 0.0:
            parts.append(f"request {self.request_s * 1e3:.2f} ms")
        if self.reply_s > 0.0:
            parts.append(f"reply {self.reply_s * 1e3:.2f} ms")
        if self.gaps_s > 0.0:
            name = "gap" if self.gaps == 1 else "gaps"
            parts.append(f"{self.gaps} {name} {self.gaps_s * 1e3:.2f} ms")
        parts.append(f"turnaround {self.turnaround_s * 1e3:.2f} ms")
        return f"{self.what}: {', '.join(parts)} -> at most {self.highest_rate_hz:.0f} Hz"


def exchange_time(
    profile: Profile,
    output: str,
    sensor: str | None,
    *,
    one_transaction: bool = True,
    block: int = 1,
) -> WireTime:
    """Return what one exchange costs: write an output and read an input.

    Args:
        profile: The device; see :func:`hilctl_drivers.profile.with_link` for another baud or gap.
        output: Name of the output.
        sensor: Name of the input; None to write only.
        one_transaction: Whether the exchange in one transaction may be used, where there is one.
        block: Samples in an exchange; more than one only for boards that stream.

    Raises:
        KeyError: No such output or input.
    """
    if isinstance(profile, ModbusProfile):
        written = profile.outputs[output]
        read = profile.inputs[sensor] if sensor is not None else None
        requests = _modbus_requests(profile, written, read, one_transaction=one_transaction)
        return requests_time(profile, requests)
    if isinstance(profile, AsciiProfile):
        lines = _ascii_lines(profile, output, sensor, one_transaction=one_transaction)
        return lines_time(profile, lines)
    return frames_time(profile, block)


def requests_time(profile: ModbusProfile, requests: Sequence[bytes]) -> WireTime:
    """Return what Modbus requests cost with their replies, one after the other.

    Args:
        profile: The device.
        requests: Their PDUs.
    """
    what = "+".join(f"FC{pdu[0]:02d}" for pdu in requests)
    turnaround_s = len(requests) * profile.turnaround_s
    link = profile.link
    if not isinstance(link, RtuLink):
        return WireTime(f"{what} over TCP", 0.0, 0.0, 0, 0.0, turnaround_s)
    sent = sum(len(rtu_adu(1, pdu)) for pdu in requests)
    received = sum(reply_size(pdu) + 3 for pdu in requests)  # unit and CRC
    gaps = 2 * len(requests)
    return WireTime(
        f"{what} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        gaps,
        gaps * link.frame_gap_s,
        turnaround_s,
    )


def _modbus_requests(
    profile: ModbusProfile,
    output: ModbusOutput,
    sensor: ModbusInput | None,
    *,
    one_transaction: bool,
) -> list[bytes]:
    at, data = profile.wire_address(output), bytes(2 * output.words)
    if sensor is not None:
        source = profile.wire_address(sensor)
        if one_transaction and profile.exchange == 23:
            return [write_read_pdu(source, sensor.words, at, data)]
        if one_transaction and profile.exchange == 76:
            return [feedback_pdu(at, data, source, sensor.words)]
    write = write_single_pdu(at, data) if output.function == 6 else write_pdu(at, data)
    if sensor is None:
        return [write]
    return [read_pdu(sensor.read_function, source, sensor.words), write]


def lines_time(profile: AsciiProfile, lines: Sequence[Line]) -> WireTime:
    """Return what lines of text cost with their replies, one after the other."""
    link = profile.link
    check = CHECKSUM_CHARS[link.checksum]
    sent = sum(len(line) + check + len(link.terminator) for line, _ in lines)
    replies = [reply for _, reply in lines if reply is not None]
    received = sum(len(reply) + check + len(link.reply_terminator) for reply in replies)
    return WireTime(
        f"{len(lines)} {'line' if len(lines) == 1 else 'lines'} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        len(lines),
        len(lines) * link.min_gap_s,
        len(replies) * profile.turnaround_s,
    )


def _ascii_lines(
    profile: AsciiProfile, output: str, sensor: str | None, *, one_transaction: bool
) -> list[Line]:
    """Return the lines of an exchange, with the longest value."""
    channel = profile.outputs[output]
    address = 0 if profile.address == "none" else profile.address

    def longest(template: str) -> str:
        texts = (template.format(value=v, address=address) for v in (channel.min, channel.max))
        return max(texts, key=len)

    combined = profile.exchange
    pair = (output, sensor)
    if one_transaction and combined != "none" and (combined.output, combined.input) == pair:
        return [(longest(combined.write), combined.example)]
    answer = None if channel.reply == "none" else channel.reply.example
    lines: list[Line] = [(longest(channel.write), answer)]
    if sensor is not None:
        source = profile.inputs[sensor]
        lines.append((source.ask.format(address=address), source.example))
    return lines


def frames_time(profile: FrameProfile, block: int) -> WireTime:
    """Return what a block costs in binary frames, with the most overhead that COBS can add."""
    link = profile.link
    stream = profile.exchange == "stream"
    size = next(iter(profile.outputs.values())).format.size
    request, reply = exchange_sizes(block, size, stream=stream)
    framing = binary_framing(link.framing, link.crc, link.payload_max)
    what = f"{block} {'sample' if block == 1 else 'samples'} in {link.framing} frames"
    byte_s, gaps, gaps_s, line = _frames_line(link)
    return WireTime(
        f"{what} {line}",
        framing.wire_size(request) * byte_s,
        framing.wire_size(reply) * byte_s,
        gaps,
        gaps_s,
        profile.turnaround_s,
        block,
    )


def _frames_line(link: FramesLink) -> tuple[float, int, float, str]:
    """Return time of a byte, number and time of gaps, and the line in words."""
    if not link.usb:
        return link.char_s, 0, 0.0, f"at {link.format}"
    full_speed = link.usb_frame_s >= 1e-3
    byte_s = 8.0 / _USB_BITS_PER_S[full_speed]
    speed = "full" if full_speed else "high"
    return byte_s, 1, link.usb_frame_s, f"over {speed}-speed USB"
