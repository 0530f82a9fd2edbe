"""Binary frames, and splitters that find messages in a stream.

COBS frame: ``COBS(payload | crc LE) 00``. Length-prefixed frame: ``length u16 LE | payload | crc
LE``, the length counting the payload alone, the CRC over length and payload. COBS: Cheshire and
Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.

Splitters find the next message again after damaged bytes.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeAlias, TypeVar

from cobs import cobs

from hilctl_drivers.transport.crc import CRCS, Bytes, Crc
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

Content = TypeVar("Content")


class Splitter(ABC, Generic[Content]):
    """Splits a stream into messages and resynchronises after damaged bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._lost = False

    @abstractmethod
    def feed(self, chunk: Bytes) -> list[Content | CorruptError]:
        """Take received bytes and return the contents that they complete, in order.

        A lost part of the stream is one :class:`CorruptError` in its place, not raised.
        """

    def reset(self) -> None:
        """Forget the received bytes, as after a timeout."""
        self._buffer.clear()
        self._lost = False


class DelimitedSplitter(Splitter[Content]):
    """A :class:`Splitter` for messages that end in bytes which occur nowhere else in them.

    Args:
        parse: Converts a message without its end, or raises CorruptError.
        end: The bytes that end a message.
        size_max: Most bytes of a good message without its end; bounds the buffer.
        skip_empty: Whether to ignore empty messages.
    """

    def __init__(
        self, parse: Callable[[Bytes], Content], end: bytes, size_max: int, *, skip_empty: bool
    ) -> None:
        super().__init__()
        self._parse = parse
        self._end = end
        self._size_max = size_max
        self._skip_empty = skip_empty

    def feed(self, chunk: Bytes) -> list[Content | CorruptError]:
        """See :meth:`Splitter.feed`."""
        out: list[Content | CorruptError] = []
        self._buffer += chunk
        *parts, self._buffer = self._buffer.split(self._end)
        for part in parts:
            if self._lost:
                self._lost = False
            elif part or not self._skip_empty:
                try:
                    out.append(self._parse(part))
                except CorruptError as error:
                    out.append(error)
        if len(self._buffer) > self._size_max + len(self._end):
            if not self._lost:
                out.append(CorruptError(f"no end within {self._size_max} bytes"))
            self._lost = True
            # The first bytes of an end may already be here.
            del self._buffer[: -len(self._end)]
        return out


class PrefixedSplitter(Splitter[bytes]):
    """A :class:`Splitter` for frames that begin with their length.

    After a bad frame it tries every byte as a beginning until a frame's check passes.

    Args:
        size_at: Returns the size of the frame at a position of the buffer, 0 if it is not known
            yet, or raises CorruptError.
        parse: Returns the payload of a frame, or raises CorruptError.
    """

    def __init__(
        self, size_at: Callable[[Bytes, int], int], parse: Callable[[bytes], bytes]
    ) -> None:
        super().__init__()
        self._size_at = size_at
        self._parse = parse

    def feed(self, chunk: Bytes) -> list[bytes | CorruptError]:
        """See :meth:`Splitter.feed`."""
        out: list[bytes | CorruptError] = []
        self._buffer += chunk
        at = 0
        while True:
            try:
                size = self._size_at(self._buffer, at)
                if not size or len(self._buffer) - at < size:
                    break
                out.append(self._parse(bytes(self._buffer[at : at + size])))
                self._lost = False
                at += size
            except CorruptError as error:
                if not self._lost:
                    out.append(error)
                self._lost = True
                at += 1
        del self._buffer[:at]
        return out


FramingKind: TypeAlias = Literal["cobs", "length"]
PAYLOAD_MAX = 4096
LENGTH_SIZE = 2


@dataclass(frozen=True)
class Framing(ABC):
    """A binary framing: payload to frame, frame to payload, stream to payloads.

    Attributes:
        crc: The check.
        payload_max: Most bytes of a payload.
    """

    crc: Crc
    payload_max: int = PAYLOAD_MAX

    def encode(self, payload: Bytes) -> bytes:
        """Return the complete frame of a payload of 1 to ``payload_max`` bytes."""
        if not 1 <= len(payload) <= self.payload_max:
            rule = f"payload must have 1 to {self.payload_max} bytes"
            raise BadRequestError(f"{rule}, got {len(payload)}")
        return self._frame(bytes(payload))

    @abstractmethod
    def decode(self, frame: Bytes) -> bytes:
        """Return the payload of exactly one frame.

        Raises:
            IncompleteError: More bytes belong to it.
            CorruptError: Its CRC or structure is wrong, or bytes follow its end.
        """

    @abstractmethod
    def wire_size(self, payload_size: int) -> int:
        """Return the most bytes that a payload of this size takes on the wire."""

    @abstractmethod
    def splitter(self) -> Splitter[bytes]:
        """Return a splitter at the beginning of a stream."""

    @abstractmethod
    def _frame(self, payload: bytes) -> bytes:
        """Return the frame of a payload of good size."""

    def _check_size(self, size: int) -> None:
        if not 1 <= size <= self.payload_max:
            raise CorruptError(f"payload must have 1 to {self.payload_max} bytes, got {size}")

    def _check_crc(self, covered: bytes, sent: bytes) -> None:
        if self.crc.of(covered) != sent:
            start = covered[:16].hex(" ")
            raise CorruptError(f"{self.crc.name} of {len(covered)} bytes is wrong: {start}")


@dataclass(frozen=True)
class CobsFraming(Framing):
    """COBS frames, see the module."""

    def _frame(self, payload: bytes) -> bytes:
        body: bytes = cobs.encode(payload + self.crc.of(payload))
        return body + b"\0"

    def decode(self, frame: Bytes) -> bytes:
        """See :meth:`Framing.decode`."""
        frame = bytes(frame)
        end = frame.find(0)
        if end < 0 and len(frame) < self.wire_size(self.payload_max):
            raise IncompleteError(f"{len(frame)} bytes without the final 00")
        if end < 0:
            raise CorruptError(f"no final 00 within {len(frame)} bytes")
        if end < len(frame) - 1:
            raise CorruptError(f"{len(frame) - end - 1} bytes behind the final 00")
        return self._payload(frame[:-1])

    def wire_size(self, payload_size: int) -> int:
        """See :meth:`Framing.wire_size`."""
        body: int = cobs.max_encoded_length(payload_size + self.crc.size)
        return body + 1

    def splitter(self) -> Splitter[bytes]:
        """See :meth:`Framing.splitter`."""
        size_max = self.wire_size(self.payload_max) - 1
        return DelimitedSplitter(self._payload, b"\0", size_max, skip_empty=True)

    def _payload(self, body: Bytes) -> bytes:
        try:
            data: bytes = cobs.decode(bytes(body))
        except cobs.DecodeError as error:
            raise CorruptError(f"not a COBS frame: {error}") from None
        size = len(data) - self.crc.size
        self._check_size(size)
        self._check_crc(data[:size], data[size:])
        return data[:size]


@dataclass(frozen=True)
class LengthFraming(Framing):
    """Length-prefixed frames, see the module; they need a CRC to find the next beginning.

    A wrong length makes a stream wait for up to ``payload_max`` bytes. Set that no higher than the
    protocol needs, and reset the splitter after a timeout.
    """

    def __post_init__(self) -> None:
        if not 1 <= self.payload_max <= 0xFFFF:
            raise BadRequestError(f"payload_max must be 1 to 65535, got {self.payload_max}")
        if not self.crc.size:
            raise BadRequestError("length-prefixed frames need a CRC: name one, or use COBS")

    def _frame(self, payload: bytes) -> bytes:
        body = len(payload).to_bytes(LENGTH_SIZE, "little") + payload
        return body + self.crc.of(body)

    def decode(self, frame: Bytes) -> bytes:
        """See :meth:`Framing.decode`."""
        size = self._size_at(frame, 0)
        if not size or len(frame) < size:
            raise IncompleteError(f"{len(frame)} bytes of a frame")
        if len(frame) > size:
            raise CorruptError(f"{len(frame) - size} bytes behind the end of the frame")
        return self._payload(bytes(frame))

    def wire_size(self, payload_size: int) -> int:
        """See :meth:`Framing.wire_size`."""
        return LENGTH_SIZE + payload_size + self.crc.size

    def splitter(self) -> Splitter[bytes]:
        """See :meth:`Framing.splitter`."""
        return PrefixedSplitter(self._size_at, self._payload)

    def _size_at(self, data: Bytes, at: int) -> int:
        """Return the size of the frame that begins at ``at``, 0 if it is not known yet."""
        if len(data) - at < LENGTH_SIZE:
            return 0
        size = data[at] | data[at + 1] << 8
        self._check_size(size)
        return self.wire_size(size)

    def _payload(self, frame: bytes) -> bytes:
        end = len(frame) - self.crc.size
        self._check_crc(frame[:end], frame[end:])
        return frame[LENGTH_SIZE:end]


def binary_framing(kind: FramingKind, crc: str, payload_max: int = PAYLOAD_MAX) -> Framing:
    """Return a framing by the names in profiles; length-prefixed frames need a CRC."""
    framing = CobsFraming if kind == "cobs" else LengthFraming
    return framing(CRCS[crc], payload_max)
