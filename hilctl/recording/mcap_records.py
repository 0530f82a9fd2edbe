"""MCAP records and chunks from bytes that may be damaged, within a budget of work and memory.

A record is valid if writing it again gives the same bytes, which verifies all its lengths and the
checksum of an attachment. A chunk is valid if its checksum is correct.
"""

import os
import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.base.errors import DataError

LARGEST_CHUNK_BYTES = 32 * 2**20
"""Largest uncompressed chunk; hilctl closes one at 5 MiB (formerly 8 MiB)."""
MOST_IN_CHUNK = 2**18
"""Most records in a chunk: three times as many as 8 MiB of the shortest messages."""
FRAME = struct.Struct("<BQ")
"""Opcode and length before every record."""
LARGEST_BYTES = 2 * LARGEST_CHUNK_BYTES
"""Largest record; a larger length is damaged."""
FOOTER_BYTES = FRAME.size + 20
"""Size of the footer, which precedes the closing magic."""
CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time of a chunk, uncompressed size, checksum, and length of the compression's
name; then follow the name, the length of the data, and the data."""
LENGTH = struct.Struct("<Q")

_FLOOR_BYTES = 64 * 2**20
_EXPANSION = 128  # about 40 for a constant signal at a rate that is a power of two
_READ_TIMES = 32
_MESSAGES = 100_000
_BYTES_PER_MESSAGE = 16  # its entry in the index
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode and length as well
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # enumerations compare slowly
_PIECE_BYTES = 65536
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}


class ReadBudget:
    """Limit of the work and memory spent on one file, in proportion to its size.

    A file of a few kilobytes can ask for gigabytes: highly compressible streams, overlapping
    records, empty messages. Recordings of hilctl stay far below these limits.
    """

    def __init__(self, size: int) -> None:
        expanded = _FLOOR_BYTES + _EXPANSION * size
        self._left = {
            "bytes of overlapping records": _FLOOR_BYTES + _READ_TIMES * size,
            "bytes uncompressed": expanded,
            "bytes of samples, ticks and events": expanded,
            "messages": _MESSAGES + size // _BYTES_PER_MESSAGE,
        }

    def read(self, size: int) -> None:
        """Count bytes read; overlapping records are read more than once."""
        self._take("bytes of overlapping records", size)

    def expand(self, size: int) -> None:
        """Count decompressed bytes."""
        self._take("bytes uncompressed", size)

    def keep(self, size: int) -> None:
        """Count bytes kept in memory."""
        self._take("bytes of samples, ticks and events", size)

    def message(self, count: int = 1) -> None:
        """Count messages."""
        self._take("messages", count)

    def _take(self, what: str, amount: int) -> None:
        self._left[what] -= amount
        if self._left[what] < 0:
            raise DataError(f"contains more {what} than a recording of its size can")


def parse(opcode: int, body: bytes) -> McapRecord | None:
    """Return the record, or None if the bytes are not exactly one record."""
    stream, builder = ReadDataStream(BytesIO(body)), RecordBuilder()
    try:
        if opcode == Opcode.MESSAGE:
            record: McapRecord = Message.read(stream, len(body))
        elif opcode in _KINDS:
            record = _KINDS[opcode].read(stream)
        else:
            return None
        record.write(builder)
    except (McapError, struct.error, ValueError, OverflowError):  # impossible lengths
        return None
    return record if builder.end()[FRAME.size :] == body else None


def records_from(stream: BinaryIO, start: int, stop: int) -> Iterator[McapRecord]:
    """Yield valid records of a file, up to the first damaged record, chunk or message."""
    stop = min(stop, stream.seek(0, os.SEEK_END))
    while start + FRAME.size <= stop:
        stream.seek(start)
        opcode, length = FRAME.unpack(stream.read(FRAME.size))
        start += FRAME.size + length
        if length > LARGEST_BYTES or start > stop or opcode in {Opcode.CHUNK, Opcode.MESSAGE}:
            return
        record = parse(opcode, stream.read(length))
        if record is None:
            return
        yield record


def footer_of(stream: BinaryIO) -> tuple[int, Footer] | None:
    """Return the offset of a file's footer, and the footer; None if it or the magic is missing."""
    footer_at = stream.seek(0, os.SEEK_END) - FOOTER_BYTES - len(MAGIC)
    if footer_at < 0:
        return None
    footer = next(records_from(stream, footer_at, footer_at + FOOTER_BYTES), None)
    stream.seek(footer_at + FOOTER_BYTES)
    if not isinstance(footer, Footer) or stream.read() != MAGIC:
        return None
    return footer_at, footer


def split(data: bytes) -> Iterator[tuple[int, int, McapRecord]]:
    """Yield start, end and record of a chunk's content, up to the first invalid record."""
    at = 0
    for _ in range(MOST_IN_CHUNK):
        if at + FRAME.size > len(data):
            return
        opcode, length = FRAME.unpack_from(data, at)
        end = at + FRAME.size + length
        if end > len(data):
            return
        record: McapRecord | None
        if opcode == _MESSAGE_OPCODE and end - at >= _MESSAGE.size:  # the library is slow
            _, _, channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, at)
            body = data[at + _MESSAGE.size : end]
            record = Message(channel_id, log_time, body, publish_time, sequence)
        else:
            record = parse(opcode, data[at + FRAME.size : end])
        if record is None:
            return
        yield at, end, record
        at = end


def inflate(compression: str, data: bytes, size: int, budget: ReadBudget) -> bytes:
    """Decompress all available bytes, to at most one byte more than ``size``.

    A decompressor returns whole blocks (zstd: up to 128 KiB), so the last block of a truncated
    stream is lost.
    """
    if not compression:
        return data
    stream: Any
    if compression == "zstd":
        # A frame may ask for a window of gigabytes.
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
        with suppress(zstandard.ZstdError):  # damaged: block by block
            if zstandard.frame_content_size(data) == size <= LARGEST_CHUNK_BYTES:
                whole = decompressor.decompress(data, allow_extra_data=False)  # twice as fast
                budget.expand(size)
                return whole
        stream = decompressor.stream_reader(data)
    elif compression == "lz4":
        stream = lz4.frame.open(BytesIO(data))
    else:
        return b""
    pieces: list[bytes] = []
    left = size + 1
    while left > 0:
        try:
            piece = stream.read(min(_PIECE_BYTES, left))
        except (zstandard.ZstdError, RuntimeError, EOFError):  # the rest is damaged
            break
        if not piece:
            break
        budget.expand(len(piece))
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


@dataclass(frozen=True, slots=True)
class Contents:
    """The content of a whole chunk.

    Attributes:
        indexes: Channel id to the expected bytes of its message index.
        unread: Messages omitted from ``records``.
    """

    records: tuple[McapRecord, ...]
    indexes: dict[int, bytes]
    unread: int = 0


def contents(chunk: Chunk, budget: ReadBudget, unread: Collection[int] = ()) -> Contents | None:
    """Return the content of a chunk with valid lengths, or None if it is damaged."""
    if chunk.uncompressed_size > LARGEST_CHUNK_BYTES:
        return None
    data = inflate(chunk.compression, chunk.data, chunk.uncompressed_size, budget)
    if len(data) != chunk.uncompressed_size:
        return None
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        return None
    records: list[McapRecord] = []
    entries: dict[int, list[int]] = {}
    left_out = end = 0
    for start, stop, record in split(data):
        end = stop
        if isinstance(record, Channel) and record.id in unread:  # its topic may have changed
            unread = ()
        if isinstance(record, Message):
            entries.setdefault(record.channel_id, []).extend((record.log_time, start))
            if record.channel_id in unread:
                left_out += 1
                continue
        records.append(record)
    if end != len(data):
        return None
    indexes = {channel_id: _index(channel_id, each) for channel_id, each in entries.items()}
    return Contents(tuple(records), indexes, left_out)


def _index(channel_id: int, entries: list[int]) -> bytes:
    """Return the message index of a channel: time and offset of each message."""
    return struct.pack(f"<HI{len(entries)}Q", channel_id, 8 * len(entries), *entries)
