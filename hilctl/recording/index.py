"""Places of a stretch of a run in a finished file, from the index at its end."""

import struct
import zlib
from bisect import bisect_right
from io import BytesIO
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.recording.mcap_records import FRAME, LARGEST_BYTES, parse, records_from
from hilctl.recording.metadata_keys import unsealed
from hilctl.recording.time_range import TimeRange
from hilctl.recording.validation import RATES_HZ, number_of

_FOOTER_BYTES = FRAME.size + 20
_CRC_BYTES = 4
_NS = 10**9
_MOST_DIGITS = 20


def places_of(stream: BinaryIO, stretch: TimeRange) -> list[int] | None:
    """Return the places of all records that a stretch needs, in order.

    These are chunks with its samples and ticks, those with events, metadata and attachments.

    Args:
        stream: Open binary file that can seek.
        stretch: The stretch of the run.

    Returns:
        Offsets; None if the file has no sound index, or does not say when its run began.

    Raises:
        DataError: A time of the stretch is not a finite number.
    """
    summary = _summary(stream)
    if summary is None:
        return None
    chunks = [record for record in summary if isinstance(record, ChunkIndex)]
    indexes = [record for record in summary if isinstance(record, AttachmentIndex | MetadataIndex)]
    events = {r.id for r in summary if isinstance(r, Channel) and r.topic == "/events"}
    facts = _run_facts(stream, indexes)
    try:
        rate_hz = number_of(facts, "sample_rate_hz", *RATES_HZ)
        start_ns = int(facts["start_unix_ns"][:_MOST_DIGITS])
    except (KeyError, ValueError):
        return None
    low, high = (start_ns + round(at * _NS / rate_hz) for at in stretch.samples(rate_hz))
    chosen = _chosen(chunks, low, high, events)
    return sorted([*(each.offset for each in indexes), *chosen])


def _chosen(chunks: list[ChunkIndex], low: int, high: int, events: set[int]) -> set[int]:
    """Return the places of chunks that overlap a time range."""
    chunks.sort(key=lambda each: each.chunk_start_offset)
    within = {
        k
        for k, each in enumerate(chunks)
        if low <= each.message_end_time and each.message_start_time < high
    }
    # A block is longer than its time says, and its ticks may be in the next chunk.
    before = bisect_right([each.message_start_time for each in chunks], low) - 1
    near = {k + step for k in {*within, before} for step in (-1, 0, 1)}
    named = {
        k
        for k, each in enumerate(chunks)
        if not each.message_index_offsets or each.message_index_offsets.keys() & events
    }
    return {chunks[k].chunk_start_offset for k in near | named if 0 <= k < len(chunks)}


def _run_facts(stream: BinaryIO, indexes: list[AttachmentIndex | MetadataIndex]) -> dict[str, str]:
    for index in indexes:
        if isinstance(index, MetadataIndex) and index.name == "hilctl.run":
            record = next(records_from(stream, index.offset, index.offset + index.length), None)
            if isinstance(record, Metadata):
                facts, right = unsealed(record.name, record.metadata)
                return facts if right else {}
    return {}


def _summary(stream: BinaryIO) -> list[McapRecord] | None:
    """Return the records of the index; None if it is damaged, missing or too large."""
    footer_at = stream.seek(0, 2) - _FOOTER_BYTES - len(MAGIC)
    stream.seek(max(0, footer_at))
    tail = stream.read()
    if footer_at < 0 or tail[0] != Opcode.FOOTER or not tail.endswith(MAGIC):
        return None
    footer = parse(Opcode.FOOTER, tail[FRAME.size : _FOOTER_BYTES])
    if not isinstance(footer, Footer) or not 0 < footer.summary_start < footer_at:
        return None
    if footer_at - footer.summary_start > LARGEST_BYTES:
        return None
    stream.seek(footer.summary_start)
    data = stream.read(footer_at - footer.summary_start)
    if footer.summary_crc != zlib.crc32(data + tail[: _FOOTER_BYTES - _CRC_BYTES]):
        return None
    try:
        return list(StreamReader(BytesIO(data + tail), skip_magic=True).records)
    except (McapError, struct.error, ValueError):
        return None
