"""Single MCAP records, taken apart with suspicion.

A record counts as whole only where writing it again gives the same bytes: then every length in it
is right, and so is an attachment's checksum.
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
"""First and last time of a chunk, its bytes uncompressed, their checksum, and the bytes of the name
of its compression, which stands behind it, and then the bytes of its data."""
LENGTH = struct.Struct("<Q")

_MESSAGE = struct.Struct("<HIQQ")
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}
_COUNT = struct.Struct("<I")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_OFFSET = struct.Struct("<HQ")
_SIZES = struct.Struct("<QQ")


def parse(opcode: int, body: bytes) -> McapRecord | None:
    """Return the record, or None where the bytes are not exactly one of its kind."""
    if opcode == Opcode.MESSAGE:
        return _message(body)
    if opcode == Opcode.METADATA:
        return _metadata(body)
    if opcode == Opcode.CHUNK:
        return _chunk(body)
    if opcode == Opcode.CHUNK_INDEX:
        return _chunk_index(body)
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


def _chunk(body: bytes) -> Chunk | None:
    # Not by the library, which copies what is in it four times.
    try:
        first, last, size, crc, name_length = CHUNK_HEAD.unpack_from(body)
        begin = CHUNK_HEAD.size + name_length + LENGTH.size
        name = body[CHUNK_HEAD.size : CHUNK_HEAD.size + name_length].decode()
        (length,) = LENGTH.unpack_from(body, begin - LENGTH.size)
    except (struct.error, UnicodeDecodeError):
        return None
    if begin + length != len(body):
        return None
    return Chunk(
        compression=name,
        data=body[begin:],
        message_end_time=last,
        message_start_time=first,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


def _chunk_index(body: bytes) -> ChunkIndex | None:
    # Nor these: eight hours have 300 000 of them.
    try:
        first, last, start, length, size = _CHUNK_INDEX.unpack_from(body)
        offsets_end = _CHUNK_INDEX.size + size
        offsets = list(_OFFSET.iter_unpack(body[_CHUNK_INDEX.size : offsets_end]))
        (index_length,) = LENGTH.unpack_from(body, offsets_end)
        name, at = _text(body, offsets_end + LENGTH.size)
        compressed, uncompressed = _SIZES.unpack_from(body, at)
    except (struct.error, ValueError):
        return None
    if at + _SIZES.size != len(body) or len(dict(offsets)) != len(offsets):
        return None
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression=name,
        compressed_size=compressed,
        message_end_time=last,
        message_index_length=index_length,
        message_index_offsets=dict(offsets),
        message_start_time=first,
        uncompressed_size=uncompressed,
    )


def _metadata(body: bytes) -> Metadata | None:
    # Not by the library, which takes many times as long: a catalogue reads two of each file.
    texts: list[str] = []
    try:
        name, at = _text(body, 0)
        (size,) = _COUNT.unpack_from(body, at)
        at += _COUNT.size
        if at + size != len(body):
            return None
        while at < len(body):
            text, at = _text(body, at)
            texts.append(text)
        facts = dict(zip(texts[::2], texts[1::2], strict=True))
    except (struct.error, ValueError):  # lengths that can't be, a key without a value, no UTF-8
        return None
    return Metadata(name=name, metadata=facts) if 2 * len(facts) == len(texts) else None


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Return a text with its length before it, and where it ends."""
    start = at + _COUNT.size
    end = start + _COUNT.unpack_from(body, at)[0]
    if end > len(body):
        raise ValueError
    return body[start:end].decode(), end


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
