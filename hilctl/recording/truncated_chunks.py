"""Salvage of truncated or damaged chunks, and search for the next record after damage."""

import re
from functools import cache
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema

from hilctl.recording import schema
from hilctl.recording.mcap_records import (
    CHUNK_HEAD,
    FRAME,
    LARGEST_BYTES,
    LARGEST_CHUNK_BYTES,
    LENGTH,
    ReadBudget,
    contents,
    inflate,
    split,
)
from hilctl.recording.validation import block_problem, decode

_WINDOW_BYTES = 4 * 2**20
_IN_CHUNKS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
# Lengths are little-endian and far below 2**40: their three highest bytes are 0.
_LIKELY = re.compile(
    rb"\x06.{5}\0{3}.{16}.{5}\0{3}.{4}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}"
    rb"|\x0c.{5}\0{3}.\0{3}hilctl\."
    rb"|\x09.{5}\0{3}.{16}.\0{3}(?:experiment|model|correction)\.yaml"
    rb"|\x0f\x04\0{7}.{4}[\x02\x03\x04\x0b]",
    re.DOTALL,
)
_LIKELY_BYTES = 64
_SECTOR = bytes(512)


def next_likely(stream: BinaryIO, at: int, size: int) -> int:
    """Return the offset of the next probable record from ``at`` on, or ``size``."""
    window = _LIKELY_BYTES  # small at first, so that a file full of candidates is read once
    while at < size:
        stream.seek(at)
        found = _LIKELY.search(stream.read(window + _LIKELY_BYTES))
        if found:
            return at + found.start()
        at += window
        window = min(2 * window, _WINDOW_BYTES)
    return size


def tail_kind(stream: BinaryIO, at: int, size: int) -> str:
    """Return the kind of a tail without records: ``zeros`` or ``unreadable bytes``."""
    for start in range(at, size, _WINDOW_BYTES):
        stream.seek(start)
        if stream.read(_WINDOW_BYTES).strip(b"\0"):
            return "unreadable bytes"
    return "zeros"


def take_chunk(raw: bytes, budget: ReadBudget, *, last: bool) -> tuple[list[McapRecord], str]:
    """Return the readable records of an invalid chunk, and the kind of its damage."""
    chunk = _as_far_as_it_goes(raw)
    if chunk is None:
        return [], "torn chunk" if last else "damaged chunk"
    inside = contents(chunk, budget)
    if inside is not None:  # only its frame is damaged
        return list(inside.records), "index"
    if not last or not _is_cut(chunk, raw):
        return [], "damaged chunk"
    whole = _before_zeros(chunk)
    data = inflate(chunk.compression, whole, chunk.uncompressed_size, budget)
    return _believable(data), "torn chunk"


def _before_zeros(chunk: Chunk) -> bytes:
    """Return data up to the zeros of a power failure; values of 0.0 before them are lost too."""
    data = chunk.data
    if chunk.compression and _SECTOR in data:  # not valid in a compressed stream
        data = data[: data.index(_SECTOR)]
    return data.rstrip(b"\0")


def _as_far_as_it_goes(raw: bytes) -> Chunk | None:
    """Return a chunk by the length of its data instead of its record, cut at the end of ``raw``."""
    start = FRAME.size + CHUNK_HEAD.size
    if len(raw) < start:
        return None
    first, last, size, crc, name_length = CHUNK_HEAD.unpack_from(raw, FRAME.size)
    name = raw[start : start + name_length]
    begin = start + name_length + LENGTH.size
    if name not in {b"", b"lz4", b"zstd"} or len(raw) < begin or size > LARGEST_CHUNK_BYTES:
        return None
    (length,) = LENGTH.unpack_from(raw, begin - LENGTH.size)
    return Chunk(
        compression=name.decode(),
        data=raw[begin : begin + length],
        message_end_time=last,
        message_start_time=first,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


def _is_cut(chunk: Chunk, raw: bytes) -> bool:
    """Return whether a chunk is truncated, by the end of the file or zeros, not damaged."""
    length = FRAME.unpack_from(raw)[1]
    return len(raw) < FRAME.size + length or chunk.data.endswith(b"\0")


def _believable(data: bytes) -> list[McapRecord]:
    """Return records without a valid checksum, up to the first that is not hilctl's.

    If invalid bytes follow instead of the start of another record, the last record may end with
    some of them and is omitted.
    """
    records: list[McapRecord] = []
    end = 0
    for _, stop, record in split(data):
        if isinstance(record, Message) and not _decodes(record):
            return records[:-1]
        records.append(record)
        end = stop
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
    """Return schema and channel of each of hilctl's channel ids, in order."""
    descriptors = schema.descriptor_set()
    return {
        number: (
            Schema(number, descriptors, "protobuf", f"hilctl.{name}"),
            Channel(number, topic, "protobuf", {}, number),
        )
        for number, (topic, name) in enumerate(schema.TOPICS.items(), start=1)
    }
