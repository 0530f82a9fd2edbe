"""Binary frames for serial streams: COBS or length-prefixed, each with a named CRC.

COBS frame: ``COBS(payload | crc LE) 00``. Length-prefixed frame: ``length u16 LE | payload | crc
LE``, the length counting the payload alone, the CRC over length and payload. COBS: Cheshire and
Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

from cobs import cobs

from hilctl_drivers.transport.crc import Bytes, Crc, named_crc
from hilctl_drivers.transport.deframers import DelimitedSplitter, PrefixedSplitter, Splitter
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

FramingKind: TypeAlias = Literal["cobs", "length"]
PAYLOAD_MAX = 4096
LENGTH_SIZE = 2


def _check_payload(payload: Bytes, payload_max: int) -> None:
    if not 1 <= len(payload) <= payload_max:
        raise BadRequestError(f"payload must have 1 to {payload_max} bytes, got {len(payload)}")


def _checked(payload: bytes, covered: bytes, sent: bytes, crc: Crc) -> bytes:
    """Return ``payload`` if ``sent`` is the CRC of ``covered``; raise Corrupt otherwise."""
    if crc.of(covered) != sent:
        raise CorruptError(f"{crc.name} of {len(covered)} bytes is wrong: {covered[:16].hex(' ')}")
    return payload


class Framing(Protocol):
    """A binary framing: payload to frame, frame to payload, stream to payloads."""

    def encode(self, payload: Bytes) -> bytes:
        """Return the whole frame of a payload.

        Raises:
            BadRequest: The payload is empty or longer than the framing allows.
        """
        ...

    def decode(self, frame: Bytes) -> bytes:
        """Return the payload of exactly one frame.

        Raises:
            Incomplete: More bytes belong to it.
            Corrupt: Its CRC or structure is wrong, or bytes follow its end.
        """
        ...

    def wire_size(self, payload_size: int) -> int:
        """Return the most bytes that a payload of this size takes on the wire."""
        ...

    def splitter(self) -> Splitter[bytes]:
        """Return a splitter at the beginning of a stream."""
        ...


@dataclass(frozen=True)
class CobsFraming:
    """COBS frames; see :class:`Framing` and the module.

    Attributes:
        crc: The check.
        payload_max: Most bytes of a payload.
    """

    crc: Crc
    payload_max: int = PAYLOAD_MAX

    def encode(self, payload: Bytes) -> bytes:
        """See :meth:`Framing.encode`."""
        _check_payload(payload, self.payload_max)
        body: bytes = cobs.encode(bytes(payload) + self.crc.of(payload))
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

    def splitter(self) -> DelimitedSplitter[bytes]:
        """See :meth:`Framing.splitter`."""
        size_max = self.wire_size(self.payload_max) - 1
        return DelimitedSplitter(self._payload, b"\0", size_max, skip_empty=True)

    def _payload(self, body: Bytes) -> bytes:
        try:
            data: bytes = cobs.decode(bytes(body))
        except cobs.DecodeError as error:
            raise CorruptError(f"not a COBS frame: {error}") from None
        size = len(data) - self.crc.size
        if not 1 <= size <= self.payload_max:
            raise CorruptError(f"payload must have 1 to {self.payload_max} bytes, got {size}")
        return _checked(data[:size], data[:size], data[size:], self.crc)


@dataclass(frozen=True)
class LengthFraming:
    """Length-prefixed frames; see :class:`Framing` and the module.

    Nothing marks a beginning, so a wrong length makes a stream wait for up to ``payload_max``
    bytes: set that no higher than the protocol needs, and reset the splitter after a time-out.

    Attributes:
        crc: The check; ``none`` is refused, as only a check can find a beginning again.
        payload_max: Most bytes of a payload.

    Raises:
        BadRequest: No check, or ``payload_max`` above what two bytes can say.
    """

    crc: Crc
    payload_max: int = PAYLOAD_MAX

    def __post_init__(self) -> None:
        if not 1 <= self.payload_max <= 0xFFFF:
            raise BadRequestError(f"payload_max must be 1 to 65535, got {self.payload_max}")
        if not self.crc.size:
            raise BadRequestError("length-prefixed frames need a CRC: name one, or use COBS")

    def encode(self, payload: Bytes) -> bytes:
        """See :meth:`Framing.encode`."""
        _check_payload(payload, self.payload_max)
        body = len(payload).to_bytes(LENGTH_SIZE, "little") + bytes(payload)
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

    def splitter(self) -> PrefixedSplitter:
        """See :meth:`Framing.splitter`."""
        return PrefixedSplitter(self._size_at, self._payload)

    def _size_at(self, data: Bytes, at: int) -> int:
        """Return the size of the frame that begins at ``at``, 0 where that can't be told yet."""
        if len(data) - at < LENGTH_SIZE:
            return 0
        size = data[at] | data[at + 1] << 8
        if not 1 <= size <= self.payload_max:
            raise CorruptError(f"payload must have 1 to {self.payload_max} bytes, got {size}")
        return self.wire_size(size)

    def _payload(self, frame: bytes) -> bytes:
        end = len(frame) - self.crc.size
        return _checked(frame[LENGTH_SIZE:end], frame[:end], frame[end:], self.crc)


def binary_framing(kind: FramingKind, crc: str, payload_max: int = PAYLOAD_MAX) -> Framing:
    """Return a framing by the names that profiles use.

    Raises:
        BadRequest: Unknown CRC, or length-prefixed frames without one.
    """
    check = named_crc(crc)
    return CobsFraming(check, payload_max) if kind == "cobs" else LengthFraming(check, payload_max)
