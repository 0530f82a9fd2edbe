"""Binary frames, and functions that find messages in a stream.

COBS frame: ``COBS(payload | crc LE) 00``. Length-prefixed frame: ``length u16 LE | payload | crc
LE``, the length counting the payload alone, the CRC over length and payload. COBS: Cheshire and
Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.

In a stream the next message after damaged bytes is found.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias, TypeVar

from cobs import cobs

from hilctl_drivers.transport.crc import CRCS, Bytes, Crc
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

Content = TypeVar("Content")


def split_at(
    received: bytearray, end: bytes, parse: Callable[[Bytes], Content]
) -> Iterator[Content]:
    """Remove the messages up to the last ``end`` from a stream; yield the good ones.

    ``parse`` converts a message without its end, or raises CorruptError.
    """
    *parts, rest = received.split(end)
    received[:] = rest
    for part in parts:
        with suppress(CorruptError):
            yield parse(part)


def split_sized(
    received: bytearray, size_of: Callable[[Bytes], int], parse: Callable[[bytes], Content]
) -> Iterator[Content]:
    """Remove the frames from a stream, each with a known size; yield the good ones.

    After an invalid frame, every byte is tried as a start until a check passes.

    Args:
        received: The stream; an incomplete frame stays in it.
        size_of: Returns the size of the first frame, 0 if it is not known yet, or raises
            CorruptError.
        parse: Converts a frame, or raises CorruptError.
    """
    while True:
        try:
            size = size_of(received)
            if not size or len(received) < size:
                return
            content = parse(bytes(received[:size]))
        except CorruptError:
            del received[0]
        else:
            del received[:size]
            yield content


FramingKind: TypeAlias = Literal["cobs", "length"]
PAYLOAD_MAX = 4096
LENGTH_SIZE = 2


@dataclass(frozen=True)
class Framing(ABC):
    """A binary framing: payload to frame, frame to payload, stream to payloads."""

    BEFORE: ClassVar[bytes] = b""
    """Sent first if a truncated frame may precede it, so that the two do not become one."""
    crc: Crc  # the check
    payload_max: int = PAYLOAD_MAX  # most bytes of a payload

    def encode(self, payload: Bytes) -> bytes:
        """Return the complete frame of a payload of 1 to ``payload_max`` bytes."""
        if not 1 <= len(payload) <= self.payload_max:
            rule = f"payload must have 1 to {self.payload_max} bytes"
            raise BadRequestError(f"{rule}, got {len(payload)}")
        return self._frame(bytes(payload))

    def decode(self, frame: Bytes) -> bytes:
        """Return the payload of exactly one frame.

        Raises:
            IncompleteError: More bytes belong to it.
            CorruptError: Its CRC or structure is wrong, or bytes follow its end.
        """
        size = self._size_of(frame)
        if not size or len(frame) < size:
            raise IncompleteError(f"{len(frame)} bytes of a frame")
        if len(frame) > size:
            raise CorruptError(f"{len(frame) - size} bytes after the end of the frame")
        return self._payload(bytes(frame))

    def missing(self, received: bytearray) -> int:
        """Return the least number of missing bytes of a frame; 0 if it is complete."""
        size = self._size_of(received)
        return max(0, size - len(received)) if size else 1

    @abstractmethod
    def wire_size(self, payload_size: int) -> int:
        """Return the most bytes that a payload of this size takes on the wire."""

    @abstractmethod
    def messages(self, received: bytearray) -> Iterator[bytes]:
        """Remove the complete frames from a stream; yield the payloads of the good ones."""

    @abstractmethod
    def _frame(self, payload: bytes) -> bytes:
        """Return the frame of a payload of good size."""

    @abstractmethod
    def _size_of(self, data: Bytes) -> int:
        """Return the size of the frame at the beginning, 0 if it is not known yet."""

    @abstractmethod
    def _payload(self, frame: Bytes) -> bytes:
        """Return the payload of a complete frame, or raise CorruptError."""

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

    BEFORE: ClassVar[bytes] = b"\0"

    def _frame(self, payload: bytes) -> bytes:
        body: bytes = cobs.encode(payload + self.crc.of(payload))
        return body + b"\0"

    def wire_size(self, payload_size: int) -> int:
        """See :meth:`Framing.wire_size`."""
        body: int = cobs.max_encoded_length(payload_size + self.crc.size)
        return body + 1

    def messages(self, received: bytearray) -> Iterator[bytes]:
        """See :meth:`Framing.messages`."""
        return split_at(received, b"\0", self._payload)

    def _size_of(self, data: Bytes) -> int:
        size = bytes(data).find(0) + 1
        if not size and len(data) >= self.wire_size(self.payload_max):
            raise CorruptError(f"no final 00 within {len(data)} bytes")
        return size

    def _payload(self, frame: Bytes) -> bytes:
        try:
            data: bytes = cobs.decode(bytes(frame).removesuffix(b"\0"))
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
    protocol needs.
    """

    def _frame(self, payload: bytes) -> bytes:
        body = len(payload).to_bytes(LENGTH_SIZE, "little") + payload
        return body + self.crc.of(body)

    def wire_size(self, payload_size: int) -> int:
        """See :meth:`Framing.wire_size`."""
        return LENGTH_SIZE + payload_size + self.crc.size

    def messages(self, received: bytearray) -> Iterator[bytes]:
        """See :meth:`Framing.messages`."""
        return split_sized(received, self._size_of, self._payload)

    def _size_of(self, data: Bytes) -> int:
        if len(data) < LENGTH_SIZE:
            return 0
        size = data[0] | data[1] << 8
        self._check_size(size)
        return self.wire_size(size)

    def _payload(self, frame: Bytes) -> bytes:
        data = bytes(frame)
        end = len(data) - self.crc.size
        self._check_crc(data[:end], data[end:])
        return data[LENGTH_SIZE:end]


def binary_framing(kind: FramingKind, crc: str, payload_max: int = PAYLOAD_MAX) -> Framing:
    """Return a framing by the names in profiles; length-prefixed frames need a CRC."""
    framing = CobsFraming if kind == "cobs" else LengthFraming
    return framing(CRCS[crc], payload_max)
