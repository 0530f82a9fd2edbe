"""LabJack's Modbus Feedback, function 76: many reads and writes in one message, done in order.

Source: LabJack's "Protocol Details [Direct Modbus TCP]". A frame is ``00 address16 words8`` to read
and ``01 address16 words8 data`` to write; a reply holds the words that were read, one frame's after
the other's. Messages are kept to the 253 bytes that the Modbus specification allows.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from hilctl_drivers.modbus.pdu import EXCEPTIONS, FEEDBACK, PDU_MAX, TCP_HEAD, tcp_adu, tcp_pdu
from hilctl_drivers.transport.links import BadRequestError, Link, MismatchError, RefusedError

FRAME_HEAD: Final = 4
"""Bytes of a frame before its data."""
_WORDS_MAX = 255
_HEAD = struct.Struct(">BHB")
_SHORTEST = TCP_HEAD + 1


@dataclass(frozen=True, slots=True)
class ReadFrame:
    """Read ``words`` registers from ``address`` on."""

    address: int
    words: int

    def encode(self) -> bytes:
        """Return the frame's bytes."""
        return _HEAD.pack(0, self.address, _counted(self.words))

    @property
    def reply_size(self) -> int:
        """Bytes of the reply that are this frame's."""
        return 2 * self.words


@dataclass(frozen=True, slots=True)
class WriteFrame:
    """Write register bytes from ``address`` on; a buffer register takes all of them."""

    address: int
    data: bytes

    def encode(self) -> bytes:
        """Return the frame's bytes."""
        words, odd = divmod(len(self.data), 2)
        if odd:
            raise BadRequestError(f"registers have 2 bytes each, got {len(self.data)} bytes")
        return _HEAD.pack(1, self.address, _counted(words)) + self.data

    @property
    def reply_size(self) -> int:
        """Bytes of the reply that are this frame's."""
        return 0


FeedbackFrame: TypeAlias = ReadFrame | WriteFrame


def _counted(words: int) -> int:
    if not 1 <= words <= _WORDS_MAX:
        raise BadRequestError(f"a frame has 1 to {_WORDS_MAX} registers, got {words}")
    return words


def frames_pdu(frames: Sequence[FeedbackFrame]) -> bytes:
    """Return the request for frames, in their order.

    Raises:
        BadRequest: It or its reply would be longer than a PDU may be, or a frame is too long.
    """
    pdu = bytes((FEEDBACK,)) + b"".join(frame.encode() for frame in frames)
    longest = max(len(pdu), 1 + sum(frame.reply_size for frame in frames))
    if longest > PDU_MAX:
        raise BadRequestError(f"a PDU has at most {PDU_MAX} bytes, got {longest}")
    return pdu


class ModbusFeedback:
    """A T-series device that is asked by function 76.

    Args:
        link: Open, or opened before the first call.
        unit: Its unit id.
    """

    def __init__(self, link: Link, unit: int) -> None:
        self._link = link
        self._unit = unit
        self._transaction = 0

    def call(self, frames: Sequence[FeedbackFrame]) -> list[bytes]:
        """Carry frames out in one message; return what each read frame found.

        Raises:
            DeviceError: No answer, not a good one, or a refusal; then the frames before the one
                that was refused may have been carried out.
        """
        self._transaction = transaction = (self._transaction + 1) & 0xFFFF
        sizes = [frame.reply_size for frame in frames if frame.reply_size]
        request = tcp_adu(transaction, self._unit, frames_pdu(frames))
        reply = self._link.transact(request, _missing, TCP_HEAD + 1 + sum(sizes))
        data = _checked(tcp_pdu(reply, transaction, self._unit), sum(sizes))
        found, start = [], 0
        for size in sizes:
            found.append(data[start : start + size])
            start += size
        return found

    def read(self, address: int, words: int) -> bytes:
        """Return registers' bytes.

        Raises:
            DeviceError: See :meth:`call`.
        """
        return self.call([ReadFrame(address, words)])[0]


def _missing(received: bytes | bytearray) -> int:
    """Return how many more bytes to wait for; nonsense is ready to be refused."""
    if len(received) < _SHORTEST:
        return _SHORTEST - len(received)
    _, protocol, length = struct.unpack_from(">HHH", received)
    if protocol or length > PDU_MAX + 1:
        return 0
    return max(0, int(length) + 6 - len(received))


def _checked(pdu: bytes, size: int) -> bytes:
    """Return the data of a reply."""
    if len(pdu) == 2 and pdu[0] == FEEDBACK | 0x80:
        code = pdu[1]
        name = EXCEPTIONS.get(code, "unknown")
        raise RefusedError(f"function {FEEDBACK} refused with exception {code} ({name})", code)
    if pdu[0] != FEEDBACK:
        raise MismatchError(f"asked with function {FEEDBACK}, answered with {pdu[0]}")
    if len(pdu) != 1 + size:
        raise MismatchError(f"reply must have {1 + size} bytes, got {len(pdu)}")
    return pdu[1:]
