"""What a chunk holds: decompressed, checked, and walked record by record.

A chunk counts as whole where its checksum is right. Where nothing but messages is in it, as in all
but the first of a run, they can be had as a table, without an object each.
"""

import struct
import threading
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from types import ModuleType
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message

from hilctl.base.types import I64, U8
from hilctl.recording.allowance import LARGEST_CHUNK_BYTES, MOST_IN_CHUNK, Allowance
from hilctl.recording.records import FRAME, LENGTH, parse

_MESSAGE_FRAME = struct.Struct("<BQHIQQ")  # opcode and length as well
_MESSAGE_BYTES = _MESSAGE_FRAME.size - FRAME.size
_LOG_TIME_AT = 6
_IS_MESSAGE = int(Opcode.MESSAGE)  # an enumeration takes longer to compare than all else here
_SHORTEST = _MESSAGE_FRAME.size
_PIECE_BYTES = 65536


def inflate(compression: str, data: bytes, size: int, allowance: Allowance) -> bytes:
    """Decompress as far as the bytes go, and at most one byte more than ``size``.

    A decompressor gives out whole blocks (zstd: up to 128 KiB), so of a stream that is cut the last
    block is lost.

    Args:
        compression: ``zstd``, ``lz4`` or empty; any other gives nothing.
        data: The stream, perhaps cut or damaged.
        size: Bytes expected.
        allowance: Counts what comes out.

    Raises:
        DataError: The file has given out more than its allowance.
    """
    if not compression:
        return data
    stream: Any
    if compression == "zstd":
        if (whole := _at_once(data, size)) is not None:
            allowance.expand(len(whole))
            return whole
        # A frame may ask for a window of gigabytes.
        limited = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
        stream = limited.stream_reader(data)
    elif compression == "lz4":
        stream = lz4.frame.open(BytesIO(data))
    else:
        return b""
    out = bytearray()
    while len(out) <= size:
        try:
            piece = stream.read(min(_PIECE_BYTES, size + 1 - len(out)))
        except (zstandard.ZstdError, RuntimeError, EOFError):  # damaged from here on
            break
        if not piece:
            break
        allowance.expand(len(piece))
        out += piece
    return bytes(out)


def _at_once(data: bytes, size: int) -> bytes | None:
    """Return what a frame of a known, right size holds; None where it is any other."""
    try:
        if size > LARGEST_CHUNK_BYTES or zstandard.frame_content_size(data) != size:
            return None
        return _of_thread.decompressor.decompress(data, allow_extra_data=False)
    except zstandard.ZstdError:
        return None


class _OfThread(threading.local):
    """A decompressor of each thread for all chunks: to make one takes as long as one of 100 ms.

    Two threads that share one get each other's bytes.
    """

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()


_of_thread = _OfThread()


@dataclass(frozen=True, slots=True)
class Contents:
    """What a whole chunk holds.

    Attributes:
        records: Schemas, channels and messages in order.
        indexes: Channel id to the bytes that its message index must have.
        unread: Messages that are left out of ``records``.
    """

    records: tuple[McapRecord, ...]
    indexes: dict[int, bytes]
    unread: int = 0


def contents(chunk: Chunk, allowance: Allowance, unread: Collection[int] = ()) -> Contents | None:
    """Return what a chunk holds, or None where its checksum or a record in it is wrong.

    Args:
        chunk: A chunk, whose own lengths are right.
        allowance: Counts what comes out of it.
        unread: Ids of channels whose messages are only counted.
    """
    data = checked(chunk, allowance)
    return None if data is None else _walked(data, unread)


def checked(chunk: Chunk, allowance: Allowance) -> bytes | None:
    """Return the bytes of a chunk's records, or None where their checksum or size is wrong."""
    if chunk.uncompressed_size > LARGEST_CHUNK_BYTES:
        return None
    data = inflate(chunk.compression, chunk.data, chunk.uncompressed_size, allowance)
    if len(data) != chunk.uncompressed_size:
        return None
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        return None
    return data


def _walked(data: bytes, unread: Collection[int]) -> Contents | None:
    """Return the records of a chunk; None where they do not fill it to its last byte."""
    records: list[McapRecord] = []
    places: dict[int, list[int]] = {}
    left_out = at = 0
    last = len(data) - _MESSAGE_FRAME.size
    while at + FRAME.size <= len(data):
        frame = _MESSAGE_FRAME if at <= last else FRAME
        head = frame.unpack_from(data, at)
        opcode, length = head[0], head[1]
        end = at + FRAME.size + length
        if end > len(data) or len(records) + left_out > MOST_IN_CHUNK:
            return None
        if opcode == _IS_MESSAGE and length >= _MESSAGE_BYTES and at <= last:
            channel_id = head[2]
            places.setdefault(channel_id, []).append(at)
            if channel_id in unread:
                left_out += 1
            else:
                body = data[at + _MESSAGE_FRAME.size : end]
                records.append(Message(channel_id, head[4], body, head[5], head[3]))
        else:
            record = parse(opcode, data[at + FRAME.size : end])
            if record is None:
                return None
            if isinstance(record, Channel) and record.id in unread:  # it may be of another topic
                return _walked(data, ())
            records.append(record)
        at = end
    if at != len(data):
        return None
    indexes = {channel_id: _index(channel_id, data, each) for channel_id, each in places.items()}
    return Contents(tuple(records), indexes, left_out)


def _index(channel_id: int, data: bytes, places: list[int]) -> bytes:
    """Return the message index of a channel: time and place of each message."""
    at = np.array(places)
    bytes_of = (at + FRAME.size + _LOG_TIME_AT)[:, None] + np.arange(LENGTH.size)
    times = np.frombuffer(data, np.uint8)[bytes_of].view("<u8")
    head = struct.pack("<HI", channel_id, 2 * LENGTH.size * at.size)
    return head + np.column_stack((times, at.astype("<u8"))).tobytes()


@dataclass(frozen=True, slots=True)
class Messages:
    """The messages of whole chunks.

    Attributes:
        data: uint8[n], what the chunks hold, one behind the other.
        table: int64[m, PLACES], see :func:`hilctl.kernels.packed.walk_messages`.
        channels: Ids of their channels.
    """

    data: U8
    table: I64
    channels: frozenset[int]

    @classmethod
    def of(cls, data: U8) -> "Messages | None":
        """Return the messages of chunks; None where they hold anything else, or are not whole."""
        packed = kernels()
        table = np.empty((min(data.size // _SHORTEST, MOST_IN_CHUNK), packed.PLACES), np.int64)
        count = packed.walk_messages(data, table)
        if count < 0:
            return None
        table = table[:count]
        return cls(data, table, frozenset(table[:, packed.CHANNEL].tolist()))

    def under(self, *channels: int) -> I64:
        """Return the rows of some channels: int64[k, PLACES]."""
        column = self.table[:, kernels().CHANNEL]
        return self.table[
            column == channels[0] if len(channels) == 1 else np.isin(column, channels)
        ]

    def records(self, rows: I64) -> list[Message]:
        """Return the messages of some rows."""
        return [self._record(start, end) for _, start, _, end, _ in rows.tolist()]

    def _record(self, start: int, end: int) -> Message:
        head = self.data[start : start + _MESSAGE_FRAME.size].tobytes()
        _, _, channel, sequence, log_time, publish_time = _MESSAGE_FRAME.unpack(head)
        body = self.data[start + _MESSAGE_FRAME.size : end].tobytes()
        return Message(channel, log_time, body, publish_time, sequence)


@cache
def kernels() -> ModuleType:
    """Return :mod:`hilctl.kernels.packed`; what it takes to load it, short files do not pay."""
    from hilctl.kernels import packed

    return packed
