"""Time range of a run: cut a recording to it, and find its records in a finished file."""

import math
import zlib
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

from mcap.records import AttachmentIndex, Channel, ChunkIndex, McapRecord, Metadata, MetadataIndex

from hilctl.base.errors import DataError
from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import Segment
from hilctl.recording import schema
from hilctl.recording.mcap_records import FOOTER_BYTES, LARGEST_BYTES, footer_of, records_from
from hilctl.recording.metadata_keys import unsealed
from hilctl.recording.recording import Recording
from hilctl.recording.validation import RATES_HZ, number_of

_END_OF_ANY_PART = {"code", "reason", "output_safe", "output_state", "ended", "recovered"}
"""Facts of the end that are valid for every part of a run; the others count the whole run."""
_CRC_BYTES = 4
_NS = 10**9
_MAX_DIGITS = 20


@dataclass(frozen=True, slots=True)
class TimeRange:
    """Time range of a run.

    Attributes:
        from_s: First time, in s since the start of the run; None for its start.
        to_s: Time after the last sample; None for the end of the run.
    """

    from_s: float | None = None
    to_s: float | None = None

    def samples(self, sample_rate_hz: float) -> tuple[int, int]:
        """Return the first sample at or after each time; raise DataError if one is not finite."""
        start = 0 if self.from_s is None else _first_at_or_after(self.from_s, sample_rate_hz)
        stop = LAST_SAMPLE if self.to_s is None else _first_at_or_after(self.to_s, sample_rate_hz)
        return start, stop

    def cut(self, recording: Recording) -> Recording:
        """Return the part of a recording in this range, with all events; raise DataError if empty.

        Segments are cut to the range, counters of the whole run are omitted, and missing samples
        are counted between the first and the last sample of the part.
        """
        (whole,) = self.cut_pieces([recording])
        return whole

    def cut_pieces(self, pieces: Iterable[Recording]) -> Iterator[Recording]:
        """Cut the pieces of a recording; raise DataError if no piece has a sample in this range.

        The last piece has the counters, and its segments end with its last sample.
        """
        held: Recording | None = None
        read = found = first = end = 0
        for piece in pieces:
            if held is not None:
                yield held
            held = self._part(piece)
            index = held.samples.index
            read += piece.samples.index.size
            if index.size:
                first, end = first if found else int(index[0]), int(index[-1]) + 1
                found += index.size
        if held is None or not found:
            whole = "its samples are outside this range" if read else "it has none"
            path = held.path if held else "the recording"
            raise DataError(f"{path}: holds no sample from {self}: {whole}")
        yield replace(
            held,
            segments=tuple(_cut(piece.segments, first, end)),
            dropped=end - first - found,
            end={name: text for name, text in held.end.items() if name in _END_OF_ANY_PART},
        )

    def _part(self, piece: Recording) -> Recording:
        start, stop = self.samples(piece.sample_rate_hz)
        ticks = piece.ticks
        within = (ticks.first_sample >= start) & (ticks.first_sample < stop)
        return replace(
            piece,
            samples=piece.samples.part(start, stop),
            segments=tuple(_cut(piece.segments, start, stop)),
            ticks=ticks.rows(within),
            starts=tuple(each for each in piece.starts if start <= each.sample < stop),
        )

    def __str__(self) -> str:
        start = "its start" if self.from_s is None else f"{self.from_s:g} s"
        return f"{start} to {'its end' if self.to_s is None else f'{self.to_s:g} s'}"


def _cut(segments: tuple[Segment, ...], start: int, stop: int) -> Iterator[Segment]:
    """Yield segments cut to a range; each keeps its first sample, the origin of its phase."""
    for each in segments:
        end = min(each.stop, stop)
        steady_start = min(max(each.steady_start, start), end)
        if start < each.stop and each.start < stop:
            steady_stop = max(steady_start, min(each.steady_stop, end))
            yield replace(each, stop=end, steady_start=steady_start, steady_stop=steady_stop)


def _first_at_or_after(t_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at ``t_s`` or later, within rounding errors."""
    if not math.isfinite(t_s):
        raise DataError(f"a time must be a finite number of seconds: {t_s!r}")
    far = float(LAST_SAMPLE)
    place = min(max(t_s * rate_hz, -far), far)
    return math.ceil(place - 1e-6)


def places_of(stream: BinaryIO, time_range: TimeRange) -> list[int] | None:
    """Return the sorted offsets of the records of a time range; None without a valid index.

    These are chunks with its samples or ticks, or with events, and all metadata and attachments.
    """
    summary = _summary(stream)
    chunks = [record for record in summary if isinstance(record, ChunkIndex)]
    indexes = [record for record in summary if isinstance(record, AttachmentIndex | MetadataIndex)]
    channels = [record for record in summary if isinstance(record, Channel)]
    events = {each.id for each in channels if schema.split_topic(each.topic)[1] == "/events"}
    facts = _run_facts(stream, indexes)
    try:
        rate_hz = number_of(facts, "sample_rate_hz", *RATES_HZ)
        start_ns = int(facts["start_unix_ns"][:_MAX_DIGITS])
    except (KeyError, ValueError):
        return None
    low, high = (start_ns + round(at * _NS / rate_hz) for at in time_range.samples(rate_hz))
    chosen = _overlapping(chunks, low, high, events)
    return sorted([*(each.offset for each in indexes), *chosen])


def _overlapping(chunks: list[ChunkIndex], low: int, high: int, events: set[int]) -> set[int]:
    """Return the offsets of chunks that overlap a time range or have events."""
    chunks.sort(key=lambda each: each.chunk_start_offset)
    within = {
        k
        for k, each in enumerate(chunks)
        if low <= each.message_end_time and each.message_start_time < high
    }
    # A block extends beyond its time stamp, and its ticks may be in the next chunk.
    before = bisect_right([each.message_start_time for each in chunks], low) - 1
    near = {k + step for k in {*within, before} for step in (-1, 0, 1)}
    with_events = {
        k
        for k, each in enumerate(chunks)
        if not each.message_index_offsets or each.message_index_offsets.keys() & events
    }
    return {chunks[k].chunk_start_offset for k in near | with_events if 0 <= k < len(chunks)}


def _run_facts(stream: BinaryIO, indexes: list[AttachmentIndex | MetadataIndex]) -> dict[str, str]:
    for index in indexes:
        if isinstance(index, MetadataIndex) and index.name == "hilctl.run":
            record = next(records_from(stream, index.offset, index.offset + index.length), None)
            if isinstance(record, Metadata):
                facts, right = unsealed(record.name, record.metadata)
                return facts if right else {}
    return {}


def _summary(stream: BinaryIO) -> list[McapRecord]:
    """Return the records of the index; empty if it is damaged, missing or too large."""
    if (place := footer_of(stream)) is None:
        return []
    footer_at, footer = place
    if not 0 < footer.summary_start < footer_at <= footer.summary_start + LARGEST_BYTES:
        return []
    stream.seek(footer.summary_start)
    checked = stream.read(footer_at - footer.summary_start + FOOTER_BYTES - _CRC_BYTES)
    if footer.summary_crc != zlib.crc32(checked):
        return []
    return list(records_from(stream, footer.summary_start, footer_at))
