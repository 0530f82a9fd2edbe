"""Parsing of requests and framing of replies: the contract, and devices on a serial line."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.ascii.ascii_session import LineFormat
from hilctl_drivers.board.board_profile import FrameProfile, FramesLink
from hilctl_drivers.transport.framing import Splitter, binary_framing
from hilctl_drivers.transport.links import CorruptError


@dataclass(frozen=True, slots=True)
class EmulatedReply:
    """A reply, before its framing."""

    data: bytes | None  # None if there is no reply, or it is not known yet
    due_ns: int = 0  # when it is sent; 0 for immediately
    make: Callable[[int], bytes] | None = None  # returns the reply when it is due
    wrong_id: Callable[[bytes], bytes] | None = None  # returns it in another's name, for a fault


SerialProfile: TypeAlias = AsciiProfile | FrameProfile


class EmulatedWire(Protocol):
    """Devices that share a line or a port, and their protocol."""

    def tick(self, now_ns: int) -> None:
        """Advance the time for all devices."""
        ...

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield complete requests, and remove them from the received bytes."""
        ...

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a request; None if it is for no device here."""
        ...

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return an answer that refuses the request."""
        ...

    def mark_invalid(self, until_ns: int) -> None:
        """Mark the readings of all devices as invalid until a time."""
        ...

    def encode(self, data: bytes) -> bytes:
        """Return a reply in the form sent on the line."""
        ...

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage must be detected."""
        ...


class SerialDevice(Protocol):
    """An emulated device on a line; it sees messages without their framing."""

    invalid_until_ns: int

    def tick(self, now_ns: int) -> None:
        """Advance the time."""
        ...

    def answer(self, message: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a message; None if it is for another device."""
        ...

    def refusal(self, message: bytes) -> EmulatedReply | None:
        """Return an answer that refuses the request."""
        ...

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply in another's name, or to something else."""
        ...


class EmulatedLine:
    """Devices on a serial line with the profile's framing; the addressed one answers."""

    def __init__(self, profile: SerialProfile, devices: Sequence[SerialDevice]) -> None:
        self.devices = devices
        self._splitter: Splitter[str] | Splitter[bytes]
        self._encode: Callable[[bytes], bytes]
        link = profile.link
        self._is_text = not isinstance(link, FramesLink)
        if isinstance(link, FramesLink):
            framing = binary_framing(link.framing, link.crc, link.payload_max)
            self._splitter, self._encode = framing.splitter(), framing.encode
        else:
            self._splitter = LineFormat(link.terminator.encode(), link.checksum).splitter()
            replies = LineFormat(link.reply_terminator.encode(), link.checksum)
            self._encode = lambda message: replies.encode(message.decode())

    def tick(self, now_ns: int) -> None:
        """Advance the time for all devices."""
        for device in self.devices:
            device.tick(now_ns)

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield the good messages; the splitter keeps an incomplete one."""
        data = bytes(received)
        received.clear()
        for each in self._splitter.feed(data):
            if each and not isinstance(each, CorruptError):
                yield each.encode() if isinstance(each, str) else each

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a message; None if it is for no device here."""
        for device in self.devices:
            answer = device.answer(request, now_ns)
            if answer is not None:
                return replace(answer, wrong_id=device.wrong_id)
        return None

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return an answer of the first device that says no."""
        return self.devices[0].refusal(request)

    def mark_invalid(self, until_ns: int) -> None:
        """Mark the readings of all devices as invalid until a time."""
        for device in self.devices:
            device.invalid_until_ns = until_ns

    def encode(self, data: bytes) -> bytes:
        """Return a reply in the form sent on the line."""
        return self._encode(data)

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage must be detected."""
        if self._is_text:
            return 0 if len(framed) < 4 else 1
        return len(framed) // 2
