"""Single MCAP records and chunks, taken apart with suspicion.

A record counts as whole only where writing it again gives the same bytes: then every length in it
is right, and so is an attachment's checksum. A chunk counts as whole where its checksum is right.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

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

FRAME = struct.Struct("<BQ")
"""Opcode and length before every record."""
LARGEST_BYTES = 2**30
"""No record that hilctl writes is larger; a length beyond it is a damaged one."""

_MESSAGE = struct.Struct("<HIQQ")
_PIECE_BYTES = 4096
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


def parse(opcode: int, body: bytes) -> McapRecord | None:
    """Return the record, or None where the bytes are not exactly one of its kind."""
    if opcode == Opcode.MESSAGE:
        return _message(body)
    if opcode not in _KINDS:
        return None
    builder = RecordBuilder()
    try:
        record: McapRecord = _KINDS[opcode].read(ReadDataStream(BytesIO(body)))
        record.write(builder)
    except (McapError, struct.error, ValueError, OverflowError):  # lengths that can't be
        return None
    return record if builder.end()[FRAME.size :] == body else None


def _message(body: bytes) -> Message | None:
    if len(body) < _MESSAGE.size:
        return None
    channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
    return Message(
        channel_id=channel_id,
        log_time=log_time,
        data=body[_MESSAGE.size :],
        publish_time=publish_time,
        sequence=sequence,
    )


def split(data: bytes) -> Iterator[tuple[int, McapRecord]]:
    """Yield offset and record of what a chunk holds, up to the first that is not whole."""
    at = 0
    while at + FRAME.size <= len(data):
        opcode, length = FRAME.unpack_from(data, at)
        start = at + FRAME.size
        if length > len(data) - start:
            return
        record = parse(opcode, data[start : start + length])
        if record is None:
            return
        yield at, record
        at = start + length


def inflate(compression: str, data: bytes, size: int) -> bytes:
    """Decompress as far as the bytes go, and at most little more than ``size`` bytes.

    A decompressor gives out whole blocks (zstd: up to 128 KiB), so of a stream that is cut the last
    block is lost.

    Args:
        compression: ``zstd``, ``lz4`` or empty; any other gives nothing.
        data: The stream, perhaps cut or damaged.
        size: Bytes expected.
    """
    if not compression:
        return data
    stream: Any
    if compression == "zstd":
        stream = zstandard.ZstdDecompressor().decompressobj()
    elif compression == "lz4":
        stream = lz4.frame.LZ4FrameDecompressor()
    else:
        return b""
    out = bytearray()
    for at in range(0, len(data), _PIECE_BYTES):
        try:
            out += stream.decompress(data[at : at + _PIECE_BYTES])
        except (zstandard.ZstdError, RuntimeError, EOFError):  # damaged from here on
            break
        if len(out) > size or stream.eof:
            break
    return bytes(out)


@dataclass(frozen=True, slots=True)
class Contents:
    """What a whole chunk holds.

    Attributes:
        records: Schemas, channels and messages in order.
        indexes: Channel id to the bytes that its message index must have.
    """

    records: tuple[McapRecord, ...]
    indexes: dict[int, bytes]


def contents(chunk: Chunk) -> Contents | None:
    """Return what a chunk holds, or None where its checksum or a record in it is wrong."""
    if chunk.uncompressed_size > LARGEST_BYTES:
        return None
    data = inflate(chunk.compression, chunk.data, chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        return None
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        return None
    records: list[McapRecord] = []
    entries: dict[int, list[int]] = {}
    end = 0
    for at, record in split(data):
        records.append(record)
        if isinstance(record, Message):
            entries.setdefault(record.channel_id, []).extend((record.log_time, at))
        end = at + FRAME.size + FRAME.unpack_from(data, at)[1]
    if end != len(data):
        return None
    return Contents(tuple(records), {key: _index(key, each) for key, each in entries.items()})


def _index(channel_id: int, entries: list[int]) -> bytes:
    return struct.pack(f"<HI{len(entries)}Q", channel_id, 8 * len(entries), *entries)
