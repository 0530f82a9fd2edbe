"""Parsing of requests and framing of replies: the base, and devices on a serial line."""

import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from string import Formatter
from typing import TypeAlias

from hilctl_drivers.ascii.ascii_profile import SAMPLES, AsciiProfile, fill
from hilctl_drivers.ascii.message_format import FrameFormat, formats
from hilctl_drivers.ascii.number_format import number_format
from hilctl_drivers.board.board_profile import FrameProfile, FramesLink
from hilctl_drivers.emulator.rig import EmulatedDevice
from hilctl_drivers.transport.crc import Bytes
from hilctl_drivers.transport.framing import binary_framing, split_sized
from hilctl_drivers.transport.links import CorruptError


@dataclass(frozen=True, slots=True)
class EmulatedReply:
    """A reply, before its framing."""

    data: bytes | None  # None if there is no reply, or it is not known yet
    due_ns: int = 0  # when it is sent; 0 for immediately
    make: Callable[[int], bytes] | None = None  # returns the reply when it is due
    wrong_id: Callable[[bytes], bytes] | None = None  # returns it in another's name, for a fault


class RejectedRequest(Exception):  # noqa: N818  a reply, not a mistake
    """The device refuses a request with a Modbus exception or a board's status, ``code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


SerialProfile: TypeAlias = AsciiProfile | FrameProfile


class EmulatedWire:
    """Devices that share a line or a port, and their protocol; this base class answers nothing."""

    devices: Sequence[EmulatedDevice] = ()

    def tick(self, now_ns: int) -> None:
        """Advance the time for all devices."""
        for device in self.devices:
            device.tick(now_ns)

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield complete requests, and remove them from the received bytes."""
        received.clear()
        return iter(())

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a request; None if it is for no device here."""

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return an answer that refuses the request."""

    def written(self, request: bytes) -> set[str]:
        """Return the names of the outputs that a request writes, and of their axes."""
        return set()

    def mark_invalid(self, until_ns: int) -> None:
        """Mark the readings of all devices as invalid until a time."""
        for device in self.devices:
            device.invalid_until_ns = until_ns

    def encode(self, data: bytes) -> bytes:
        """Return a reply in the form sent on the line."""
        return data

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage must be detected."""
        raise NotImplementedError


class SerialDevice(EmulatedDevice):
    """An emulated device on a line; it sees messages without their framing."""

    @abstractmethod
    def answer(self, message: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a message; None if it is for another device."""

    @abstractmethod
    def refusal(self, message: bytes) -> EmulatedReply | None:
        """Return an answer that refuses the message."""

    @abstractmethod
    def written(self, message: bytes) -> set[str]:
        """Return the outputs that a message writes."""

    @abstractmethod
    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply with another address, or to another request."""


class TemplateMatcher:
    """Reads the fields of lines that were made with a template, sent to ``address``."""

    def __init__(self, text: str, address: int) -> None:
        self._parse: dict[str, Callable[[str], float]] = {}
        self.size = len(fill(text, **SAMPLES | {"address": address}))
        """Characters of a line; of frames all have as many."""
        parts = []
        for literal, field, spec, _ in Formatter().parse(text):
            parts.append(re.escape(literal))
            if field == "address":
                parts.append(re.escape(fill(f"{{address:{spec}}}", address=address)))
            elif field is not None:
                form = number_format(spec or "")
                self._parse[field] = form.number
                parts.append(f"(?P<{field}>{form.regex})")
        self._pattern = re.compile("".join(parts), re.ASCII)

    def match(self, text: str) -> dict[str, float] | None:
        """Return the fields of a line; None if the line does not match."""
        found = self._pattern.fullmatch(text)
        if found is None:
            return None
        return {name: self._parse[name](each) for name, each in found.groupdict().items()}


def _frame_size(form: FrameFormat, profile: AsciiProfile) -> Callable[[Bytes], int]:
    """Return a function of received bytes: the size of the request that they begin with."""
    lines = [line for _, text in profile.requests() for line in text.split("\n")]
    known = [TemplateMatcher(line, profile.unit) for line in lines]
    known.sort(key=lambda each: -each.size)

    def size_of(data: Bytes) -> int:
        for each in known:
            size = (each.size + 1) // 3 + form.check.size
            if len(data) >= size and each.match(form.text(data[:size])) is not None:
                return size
        if len(data) > known[0].size // 3 + form.check.size:
            raise CorruptError("no request begins here")
        return 0

    return size_of


class EmulatedLine(EmulatedWire):
    """Devices on a serial line with the profile's framing; the addressed one answers."""

    devices: Sequence[SerialDevice]

    def __init__(self, profile: SerialProfile, devices: Sequence[SerialDevice]) -> None:
        self.devices = devices
        self._received = bytearray()
        self._messages: Callable[[bytearray], Iterator[str] | Iterator[bytes]]
        self._encode: Callable[[bytes], bytes]
        link = profile.link
        self._is_text, self._echoes = not isinstance(link, FramesLink), False
        if isinstance(link, FramesLink):
            framing = binary_framing(link.framing, link.crc, link.payload_max)
            self._messages, self._encode = framing.messages, framing.encode
        else:
            assert isinstance(profile, AsciiProfile)
            requests, replies = formats(link)
            if isinstance(requests, FrameFormat):
                size_of, decode = _frame_size(requests, profile), requests.decode
                self._messages = lambda received: split_sized(received, size_of, decode)
            else:
                self._messages = requests.messages
            self._encode = lambda message: replies.wire(message.decode())
            self._echoes = link.echo

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield the valid messages; an incomplete one is kept without a time limit."""
        self._received += received
        received.clear()
        for each in self._messages(self._received):
            if each:
                yield each.encode() if isinstance(each, str) else each

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a message; None if it is for no device here."""
        for device in self.devices:
            answer = device.answer(request, now_ns)
            if answer is not None:
                if self._echoes:
                    answer = replace(answer, data=b"\n".join(filter(None, (request, answer.data))))
                return replace(answer, wrong_id=device.wrong_id)
        return None

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return the refusal of the first device that gives one."""
        return self.devices[0].refusal(request)

    def written(self, request: bytes) -> set[str]:
        """See :meth:`EmulatedWire.written`."""
        return set[str]().union(*(each.names(each.written(request)) for each in self.devices))

    def encode(self, data: bytes) -> bytes:
        """Return a reply in the form sent on the line."""
        return self._encode(data)

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage must be detected."""
        if self._is_text:
            return 0 if len(framed) < 4 else 1
        return len(framed) // 2
