"""One emulated serial line: a pty, its framing, and the devices on it."""

import os
import pty
import termios
import tty
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.emulator.answer import Answer, SerialDevice
from hilctl_drivers.text.lines import LineFormat
from hilctl_drivers.text.profile import AsciiProfile
from hilctl_drivers.wire.errors import Corrupt
from hilctl_drivers.wire.framing import Framing, binary_framing

_CHUNK = 65536


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
        return [each.encode() for each in found if not isinstance(each, Corrupt) and each]

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
        return [each for each in self._splitter.feed(data) if not isinstance(each, Corrupt)]

    def encode(self, message: bytes) -> bytes:
        """See :meth:`LineFraming.encode`."""
        return self._framing.encode(message)

    def corrupt_at(self, reply: bytes) -> int:
        """See :meth:`LineFraming.corrupt_at`."""
        return len(reply) // 2


class SerialLine:
    """A pty with devices on it.

    Args:
        framing: What its messages look like.
        devices: Who hears them; the first that is meant answers.
    """

    def __init__(self, framing: LineFraming, devices: Sequence[SerialDevice]) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self._master, False)
        self.framing = framing
        self.devices = devices
        self.name = os.ttyname(self._slave)
        self.plugged = True
        self._unsent = bytearray()

    def fileno(self) -> int:
        """What to wait for."""
        return self._master

    @property
    def has_unsent(self) -> bool:
        """Whether bytes wait for room, as they would in a USB device's buffer."""
        return bool(self._unsent)

    def read(self) -> list[bytes]:
        """Return the messages that have come."""
        with suppress(BlockingIOError):
            return self.framing.feed(os.read(self._master, _CHUNK))
        return []

    def send(self, data: bytes) -> None:
        """Send bytes, as far as there is room; the rest with the next :meth:`send`."""
        self._unsent += data
        with suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: os.write(self._master, self._unsent)]

    def hear(self, message: bytes, now_ns: int) -> tuple[SerialDevice, Answer] | None:
        """Return who answers a message, and what."""
        for device in self.devices:
            answer = device.hear(message, now_ns)
            if answer is not None:
                return device, answer
        return None

    def unplug(self) -> None:
        """Take the port away, as a pulled adapter does."""
        if self.plugged:
            self.plugged = False
            os.close(self._master)
            os.close(self._slave)
