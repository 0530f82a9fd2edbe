"""Messages on an emulated serial line: its framing, and the devices on it."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.ascii.lines import LineFormat
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.emulator.wire import EmulatedReply
from hilctl_drivers.transport.framing import Framing, binary_framing
from hilctl_drivers.transport.links import CorruptError


class LineFraming(Protocol):
    """Messages in, messages out."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the good messages that ``data`` completes; damaged ones are dropped."""
        ...

    def encode(self, message: bytes) -> bytes:
        """Return a reply as it stands on the line."""
        ...

    def corrupt_at(self, reply: bytes) -> int:
        """Return the byte of a framed reply whose damage must be found out."""
        ...


class TextFraming:
    """Lines of text.

    Args:
        profile: What the line is like.
    """

    def __init__(self, profile: AsciiProfile) -> None:
        line = profile.link
        self._splitter = LineFormat(line.terminator.encode(), line.checksum).splitter()
        self._replies = LineFormat(line.reply_terminator.encode(), line.checksum)

    def feed(self, data: bytes) -> list[bytes]:
        """See :meth:`LineFraming.feed`."""
        found = self._splitter.feed(data)
        return [each.encode() for each in found if not isinstance(each, CorruptError) and each]

    def encode(self, message: bytes) -> bytes:
        """See :meth:`LineFraming.encode`."""
        return self._replies.encode(message.decode())

    def corrupt_at(self, reply: bytes) -> int:
        """See :meth:`LineFraming.corrupt_at`."""
        return 0 if len(reply) < 4 else 1


class FrameFraming:
    """Binary frames.

    Args:
        profile: What the line is like.
    """

    def __init__(self, profile: FrameProfile) -> None:
        link = profile.link
        self._framing: Framing = binary_framing(link.framing, link.crc, link.payload_max)
        self._splitter = self._framing.splitter()

    def feed(self, data: bytes) -> list[bytes]:
        """See :meth:`LineFraming.feed`."""
        return [each for each in self._splitter.feed(data) if not isinstance(each, CorruptError)]

    def encode(self, message: bytes) -> bytes:
        """See :meth:`LineFraming.encode`."""
        return self._framing.encode(message)

    def corrupt_at(self, reply: bytes) -> int:
        """See :meth:`LineFraming.corrupt_at`."""
        return len(reply) // 2


class SerialDevice(Protocol):
    """An emulated device on a line; it sees messages without their framing."""

    def tick(self, now_ns: int) -> None:
        """Let time pass."""
        ...

    def answer(self, message: bytes, now_ns: int) -> EmulatedReply | None:
        """Carry out a message; None where it is for another device."""
        ...

    def refusal(self, message: bytes) -> EmulatedReply | None:
        """Return an answer that says no."""
        ...

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply in another's name, or to something else."""
        ...


class EmulatedLine:
    """Devices on a serial line.

    Args:
        framing: What its messages look like.
        devices: What is on it; the first that a message is for answers.
    """

    def __init__(self, framing: LineFraming, devices: Sequence[SerialDevice]) -> None:
        self.framing = framing
        self.devices = devices

    def tick(self, now_ns: int) -> None:
        """Let time pass for all devices."""
        for device in self.devices:
            device.tick(now_ns)

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield the good messages; the framing keeps what is not complete."""
        data = bytes(received)
        received.clear()
        yield from self.framing.feed(data)

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Carry out a message; None where it is for no device here."""
        for device in self.devices:
            answer = device.answer(request, now_ns)
            if answer is not None:
                return replace(answer, wrong_id=device.wrong_id)
        return None

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return an answer of the first device that says no."""
        return self.devices[0].refusal(request)

    def encode(self, data: bytes) -> bytes:
        """Return a reply as it stands on the line."""
        return self.framing.encode(data)

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage must be found out."""
        return self.framing.corrupt_at(framed)
