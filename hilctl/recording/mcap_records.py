"""Single MCAP records from bytes that may be damaged.

A record is whole only if writing it again gives the same bytes: then every length in it is right,
and so is the checksum of an attachment.
"""

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

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

from hilctl.recording.allowance import LARGEST_CHUNK_BYTES

FRAME = struct.Struct("<BQ")
"""Opcode and length before every record."""
LARGEST_BYTES = 2 * LARGEST_CHUNK_BYTES
"""No record that hilctl writes is larger; a length beyond it is a damaged one."""
CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time of a chunk, its uncompressed size, its checksum, and the length of the name
of its compression, which follows, and then the length of its data and the data."""
LENGTH = struct.Struct("<Q")

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
    """Return the record, or None if the bytes are not exactly one of its kind."""
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


def split(data: bytes) -> Iterator[tuple[int, McapRecord]]:
    """Yield offset and record of the content of a chunk, up to the first that is not whole."""
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
