"""Where in a finished file a stretch of its run stands, by the index at its end."""

import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Footer, McapRecord, Metadata, MetadataIndex
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.recording.checks import RATES_HZ, number_of
from hilctl.recording.facts import unsealed
from hilctl.recording.records import FRAME, parse
from hilctl.recording.stretch import Stretch

_FOOTER = struct.Struct("<BQQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_CHANNEL = struct.Struct("<HQ")
_MOST_BYTES = 2**28  # of an index: a chunk every 100 ms takes 4 MB an hour
_NS = 10**9
_MOST_DIGITS = 20


@dataclass(frozen=True, slots=True)
class _ChunkPlace:
    """A chunk: where it begins, its channels, and the first and last time of its messages in ns."""

    start: int
    channels: frozenset[int]
    first_ns: int
    last_ns: int


def places_of(stream: BinaryIO, stretch: Stretch) -> list[int] | None:
    """Return where all records stand that a stretch needs, in order.

    These are chunks with its samples and ticks, those with events, metadata and attachments.

    Args:
        stream: Open binary file that can seek.
        stretch: What is wanted of the run.

    Returns:
        Offsets; None where the file has no sound index, or does not say when its run began.

    Raises:
        DataError: A time of the stretch is not a finite number.
    """
    summary = _summary(stream)
    if summary is None:
        return None
    chunks: list[_ChunkPlace] = []
    others: list[int] = []
    topics: dict[int, str] = {}
    facts: dict[str, str] = {}
    for record in summary:
        match record:
            case _ChunkPlace():
                chunks.append(record)
            case Channel():
                topics[record.id] = record.topic
            case AttachmentIndex() | MetadataIndex():
                others.append(record.offset)
                facts = facts or _run_facts(stream, record)
    try:
        rate_hz = number_of(facts, "sample_rate_hz", *RATES_HZ)
        start_ns = int(facts["start_unix_ns"][:_MOST_DIGITS])
    except (KeyError, ValueError):
        return None
    low, high = (start_ns + round(at * _NS / rate_hz) for at in stretch.samples(rate_hz))
    events = {number for number, topic in topics.items() if topic == "/events"}
    chosen = _chosen(chunks, low, high, events)
    return sorted([*others, *(chunks[k].start for k in chosen)])


def _chosen(chunks: list[_ChunkPlace], low: int, high: int, events: set[int]) -> set[int]:
    """Return which chunks, in the order of the file, reach into a time."""
    chunks.sort(key=lambda each: each.start)
    within = {k for k, each in enumerate(chunks) if low <= each.last_ns and each.first_ns < high}
    # A block is longer than its time says, and its ticks may stand in the next chunk.
    before = bisect_right([each.first_ns for each in chunks], low) - 1
    near = {k + step for k in {*within, before} for step in (-1, 0, 1)}
    named = {k for k, each in enumerate(chunks) if not each.channels or each.channels & events}
    return {k for k in near | named if 0 <= k < len(chunks)}


def _run_facts(stream: BinaryIO, index: AttachmentIndex | MetadataIndex) -> dict[str, str]:
    if index.name != "hilctl.run":
        return {}
    stream.seek(index.offset)
    raw = stream.read(min(index.length, _MOST_BYTES))
    record = parse(raw[0], raw[FRAME.size :]) if len(raw) > FRAME.size else None
    if not isinstance(record, Metadata):
        return {}
    facts, right = unsealed(record.name, record.metadata)
    return facts if right else {}


def _summary(stream: BinaryIO) -> Iterator[McapRecord | _ChunkPlace] | None:
    """Return what stands in the index; None where it is damaged, missing or too large."""
    size = stream.seek(0, 2)
    footer_at = size - _FOOTER.size - len(MAGIC)
    stream.seek(max(0, footer_at))
    raw = stream.read()
    if footer_at < 0 or not raw.endswith(MAGIC) or raw[0] != Opcode.FOOTER:
        return None
    footer = parse(Opcode.FOOTER, raw[FRAME.size : _FOOTER.size])
    if not isinstance(footer, Footer) or not 0 < footer.summary_start < footer_at:
        return None
    if footer_at - footer.summary_start > _MOST_BYTES:
        return None
    stream.seek(footer.summary_start)
    data = stream.read(footer_at - footer.summary_start)
    checked = zlib.crc32(raw[: _FOOTER.size - 4], zlib.crc32(data))
    return _entries(data) if footer.summary_crc == checked else None


def _entries(data: bytes) -> Iterator[McapRecord | _ChunkPlace]:
    at = 0
    while at + FRAME.size <= len(data):
        opcode, length = FRAME.unpack_from(data, at)
        start = at + FRAME.size
        at = start + length
        if opcode == Opcode.CHUNK_INDEX:
            # Not by the library: eight hours have 300 000 of them.
            first, last, place, _, size = _CHUNK_INDEX.unpack_from(data, start)
            begin = start + _CHUNK_INDEX.size
            named = data[begin : begin + size // _CHANNEL.size * _CHANNEL.size]
            channels = frozenset(number for number, _ in _CHANNEL.iter_unpack(named))
            yield _ChunkPlace(place, channels, first, last)
        elif opcode in {Opcode.CHANNEL, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}:
            record = parse(opcode, data[start:at])
            if record is not None:
                yield record
