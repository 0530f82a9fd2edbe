"""Single MCAP records and chunks, taken apart with suspicion, and what is left of broken ones.

A record counts as whole only where writing it again gives the same bytes: then every length in it
is right, and so is an attachment's checksum. A chunk counts as whole where its checksum is right.
"""

import re
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
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

from hilctl.recording import schema
from hilctl.recording.allowance import LARGEST_CHUNK_BYTES, MOST_IN_CHUNK, Allowance
from hilctl.recording.checks import block_problem, decode

FRAME = struct.Struct("<BQ")
"""Opcode and length before every record."""
LARGEST_BYTES = 2 * LARGEST_CHUNK_BYTES
"""No record that hilctl writes is larger; a length beyond it is a damaged one."""

_MESSAGE = struct.Struct("<HIQQ")
_MESSAGE_FRAME = struct.Struct("<BQHIQQ")  # opcode and length as well
_LOG_TIME_AT = 6
_IS_MESSAGE = int(Opcode.MESSAGE)  # an enumeration takes longer to compare than all else here
_PIECE_BYTES = 65536
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_COUNT = struct.Struct("<I")
_WINDOW_BYTES = 4 * 2**20
_IN_CHUNKS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
# Lengths are little-endian and far below 2**40, so their three highest bytes are 0.
_LIKELY = re.compile(
    rb"\x06.{5}\0{3}.{16}.{5}\0{3}.{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}"
    rb"|\x0c.{5}\0{3}.\0{3}hilctl\."
    rb"|\x09.{5}\0{3}.{16}.\0{3}(?:experiment|model|correction)\.yaml"
    rb"|\x0f\x04\0{7}.{4}[\x02\x03\x04\x0b]",
    re.DOTALL,
)
_LIKELY_BYTES = 64
_SECTOR = bytes(512)


def parse(opcode: int, body: bytes) -> McapRecord | None:
    """Return the record, or None where the bytes are not exactly one of its kind."""
    if opcode == Opcode.MESSAGE:
        return _message(body)
    if opcode == Opcode.METADATA:
        return _metadata(body)
    if opcode == Opcode.CHUNK:
        return _chunk(body)
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
        first, last, size, crc, name_length = _CHUNK.unpack_from(body)
        begin = _CHUNK.size + name_length + _LENGTH.size
        name = body[_CHUNK.size : _CHUNK.size + name_length].decode()
        (length,) = _LENGTH.unpack_from(body, begin - _LENGTH.size)
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
        return _decompressor().decompress(data, allow_extra_data=False)
    except zstandard.ZstdError:
        return None


@cache
def _decompressor() -> zstandard.ZstdDecompressor:
    """Return one for all chunks: to make one takes as long as a chunk of 100 ms."""
    return zstandard.ZstdDecompressor()


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
        if opcode == _IS_MESSAGE and length >= _MESSAGE.size and at <= last:
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
    bytes_of = (at + FRAME.size + _LOG_TIME_AT)[:, None] + np.arange(_LENGTH.size)
    times = np.frombuffer(data, np.uint8)[bytes_of].view("<u8")
    head = struct.pack("<HI", channel_id, 2 * _LENGTH.size * at.size)
    return head + np.column_stack((times, at.astype("<u8"))).tobytes()


def next_likely(stream: BinaryIO, at: int, size: int) -> int:
    """Return the offset of what looks like a record from ``at`` on, or ``size``."""
    window = _LIKELY_BYTES  # small at first: a file full of likely places is still read but once
    while at < size:
        stream.seek(at)
        found = _LIKELY.search(stream.read(window + _LIKELY_BYTES))
        if found:
            return at + found.start()
        at += window
        window = min(2 * window, _WINDOW_BYTES)
    return size


def tail_kind(stream: BinaryIO, at: int, size: int) -> str:
    """Return what a tail that holds no record is: ``zeros`` or ``unreadable bytes``."""
    for start in range(at, size, _WINDOW_BYTES):
        stream.seek(start)
        if stream.read(_WINDOW_BYTES).strip(b"\0"):
            return "unreadable bytes"
    return "zeros"


def take_chunk(raw: bytes, allowance: Allowance, *, last: bool) -> tuple[list[McapRecord], str]:
    """Take what can be had of a chunk that is not whole.

    Args:
        raw: The chunk from its opcode on, up to the next readable record.
        allowance: Counts what comes out of it.
        last: Whether the file ends with these bytes.

    Returns:
        Records, and what the stretch is (see :class:`hilctl.recording.salvage.Damage`).
    """
    chunk = _as_far_as_it_goes(raw)
    if chunk is None:
        return [], "torn chunk" if last else "damaged chunk"
    inside = contents(chunk, allowance)
    if inside is not None:  # only the frame around it is damaged
        return list(inside.records), "index"
    if not last or not _is_cut(chunk, raw):
        return [], "damaged chunk"
    whole = _before_zeros(chunk)
    data = inflate(chunk.compression, whole, chunk.uncompressed_size, allowance)
    return _believable(data), "torn chunk"


def _before_zeros(chunk: Chunk) -> bytes:
    """Return data up to where a failing power left zeros; values of 0.0 at the cut go with them."""
    data = chunk.data
    if chunk.compression and _SECTOR in data:  # a compressed stream has no such stretch
        data = data[: data.index(_SECTOR)]
    return data.rstrip(b"\0")


def _as_far_as_it_goes(raw: bytes) -> Chunk | None:
    """Return a chunk by the length of its data, not of the record; its data ends with ``raw``."""
    start = FRAME.size + _CHUNK.size
    if len(raw) < start:
        return None
    first, last, size, crc, name_length = _CHUNK.unpack_from(raw, FRAME.size)
    name = raw[start : start + name_length]
    begin = start + name_length + _LENGTH.size
    if name not in {b"", b"lz4", b"zstd"} or len(raw) < begin or size > LARGEST_CHUNK_BYTES:
        return None
    (length,) = _LENGTH.unpack_from(raw, begin - _LENGTH.size)
    return Chunk(
        compression=name.decode(),
        data=raw[begin : begin + length],
        message_end_time=last,
        message_start_time=first,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


def _is_cut(chunk: Chunk, raw: bytes) -> bool:
    """Return whether a chunk ends early, with the file or in zeros, rather than being wrong."""
    length = FRAME.unpack_from(raw)[1]
    return len(raw) < FRAME.size + length or chunk.data.endswith(b"\0")


def _believable(data: bytes) -> list[McapRecord]:
    """Return records that no checksum covers, up to the first that is not hilctl's.

    Where nonsense follows rather than the beginning of one more record, the last record may have
    some of it in its own last bytes, and is left out.
    """
    records: list[McapRecord] = []
    end = 0
    for at, record in split(data):
        if isinstance(record, Message) and not _decodes(record):
            return records[:-1]
        records.append(record)
        if len(records) > MOST_IN_CHUNK:
            return []
        end = at + FRAME.size + FRAME.unpack_from(data, at)[1]
    rest = data[end:]
    if len(rest) >= FRAME.size:
        opcode, length = FRAME.unpack_from(rest)
        begun = opcode in _IN_CHUNKS and len(rest) - FRAME.size < length <= LARGEST_BYTES
        return records if begun else records[:-1]
    return records if not rest or rest[0] in _IN_CHUNKS else records[:-1]


def _decodes(message: Message) -> bool:
    own = own_channels().get(message.channel_id)
    if own is None:
        return False
    decoded, problem = decode(own[1].topic, message.data)
    if problem or own[1].topic != "/samples":
        return not problem
    return not block_problem(decoded, 0)


@cache
def own_channels() -> dict[int, tuple[Schema, Channel]]:
    """Return the schema and channel of each of hilctl's channel ids, in order."""
    descriptors = schema.descriptor_set()
    return {
        number: (
            Schema(number, descriptors, "protobuf", f"hilctl.{name}"),
            Channel(number, topic, "protobuf", {}, number),
        )
        for number, (topic, name) in enumerate(schema.TOPICS.items(), start=1)
    }
