"""The content of a chunk: decompressed, checked and split into records.

A chunk is whole if its checksum is right.
"""

import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message

from hilctl.recording.allowance import LARGEST_CHUNK_BYTES, MOST_IN_CHUNK, Allowance
from hilctl.recording.mcap_records import FRAME, parse

_MESSAGE_FRAME = struct.Struct("<BQHIQQ")  # opcode and length as well
_MESSAGE_BYTES = _MESSAGE_FRAME.size - FRAME.size
_IS_MESSAGE = int(Opcode.MESSAGE)  # comparing with an enumeration is slow
_PIECE_BYTES = 65536


def inflate(compression: str, data: bytes, size: int, allowance: Allowance) -> bytes:
    """Decompress as far as the bytes go, and at most one byte more than ``size``.

    A decompressor returns whole blocks (zstd: up to 128 KiB), so the last block of a truncated
    stream is lost.

    Args:
        compression: ``zstd``, ``lz4`` or empty; any other returns nothing.
        data: The stream, maybe truncated or damaged.
        size: Bytes expected.
        allowance: Counts the bytes returned.

    Raises:
        DataError: The file exceeds its allowance.
    """
    if not compression:
        return data
    stream: Any
    if compression == "zstd":
        # A frame may ask for a window of gigabytes.
        limited = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
        stream = limited.stream_reader(data)
    elif compression == "lz4":
        stream = lz4.frame.open(BytesIO(data))
    else:
        return b""
    pieces: list[bytes] = []
    left = size + 1
    while left > 0:
        try:
            piece = stream.read(min(_PIECE_BYTES, left))
        except (zstandard.ZstdError, RuntimeError, EOFError):  # damaged from here on
            break
        if not piece:
            break
        allowance.expand(len(piece))
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


@dataclass(frozen=True, slots=True)
class Contents:
    """The content of a whole chunk.

    Attributes:
        records: Schemas, channels and messages in order.
        indexes: Channel id to the expected bytes of its message index.
        unread: Messages that are left out of ``records``.
    """

    records: tuple[McapRecord, ...]
    indexes: dict[int, bytes]
    unread: int = 0


def contents(chunk: Chunk, allowance: Allowance, unread: Collection[int] = ()) -> Contents | None:
    """Return the content of a chunk, or None if its checksum or a record in it is wrong.

    Args:
        chunk: A chunk whose own lengths are right.
        allowance: Counts the bytes that are decompressed.
        unread: Ids of channels whose messages are only counted.
    """
    if chunk.uncompressed_size > LARGEST_CHUNK_BYTES:
        return None
    data = inflate(chunk.compression, chunk.data, chunk.uncompressed_size, allowance)
    if len(data) != chunk.uncompressed_size:
        return None
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        return None
    return _split(data, unread)


def _split(data: bytes, unread: Collection[int]) -> Contents | None:
    """Return the records of a chunk; None unless they fill it to its last byte."""
    records: list[McapRecord] = []
    entries: dict[int, list[int]] = {}
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
            channel_id, sequence, log_time, publish_time = head[2:]
            entries.setdefault(channel_id, []).extend((log_time, at))
            if channel_id in unread:
                left_out += 1
            else:
                body = data[at + _MESSAGE_FRAME.size : end]
                records.append(Message(channel_id, log_time, body, publish_time, sequence))
        else:
            record = parse(opcode, data[at + FRAME.size : end])
            if record is None:
                return None
            if isinstance(record, Channel) and record.id in unread:  # its topic may have changed
                return _split(data, ())
            records.append(record)
        at = end
    if at != len(data):
        return None
    indexes = {channel_id: _index(channel_id, each) for channel_id, each in entries.items()}
    return Contents(tuple(records), indexes, left_out)


def _index(channel_id: int, entries: list[int]) -> bytes:
    """Return the message index of a channel: time and place of each message."""
    return struct.pack(f"<HI{len(entries)}Q", channel_id, 8 * len(entries), *entries)
