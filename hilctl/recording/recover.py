"""Recovery of a truncated or damaged recording; the original bytes are kept.

The file is read twice: a survey of its damage and content, then, if it is damaged, a copy of every
valid record to a new file with a new index, statistics and checksums.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema

from hilctl import __version__
from hilctl.base.errors import DataError, InputError
from hilctl.base.events import Event
from hilctl.base.files import open_binary, reason
from hilctl.base.private_dirs import HAS_LOCKS
from hilctl.base.samples import LAST_SAMPLE, BlockBatch, BlockHeader
from hilctl.recording.encoder import MessageMaker, RecordingLayout, Topics, event_message
from hilctl.recording.metadata_keys import AXIS_FACT, CHECKSUM_FACT, sealed, unsealed
from hilctl.recording.recording_files import Replacement, lock
from hilctl.recording.recovery_scan import Damage, RecoveryScan
from hilctl.recording.validation import MAX_UNIX_NS, MessageValidator, count_of, sound_blocks
from hilctl.recording.writer import mcap_writer

_UNKNOWN_END = (
    "later samples are unknown: at most the last unflushed interval if hilctl was killed, possibly "
    "more after a power failure"
)


@dataclass(frozen=True, slots=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        original: Where the original bytes are kept; None if nothing was written because nothing
            could be repaired.
        reason: Damage and losses, in one line.
        added_samples: Samples that were not in the original.
    """

    path: Path
    original: Path | None
    reason: str
    samples: int
    added_samples: int
    missing_samples: int
    damages: tuple[Damage, ...]

    @property
    def sound(self) -> bool:
        """Whether the original was intact."""
        return self.original is None and not self.damages

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return {
            "path": str(self.path),
            "sound": self.sound,
            "original": str(self.original) if self.original else None,
            "reason": self.reason,
            "samples": self.samples,
            "added_samples": self.added_samples,
            "missing_samples": self.missing_samples,
            "damages": [str(damage) for damage in self.damages],
        }


class Survey:
    """Content and damage of a file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._sound = MessageValidator()
        self.scan = RecoveryScan(stream, self._sound)
        self.run: dict[str, str] = {}
        self.end: dict[str, str] = {}
        self.end_is_right = True
        self.last_time_ns = 0
        self.records = 0
        for record in self.scan.records():
            self._take(record)

    def _take(self, record: McapRecord) -> None:
        match record:
            case Metadata(name="hilctl.run"):
                self.run, _ = unsealed(record.name, record.metadata)
            case Metadata(name="hilctl.end"):
                self.end, self.end_is_right = unsealed(record.name, record.metadata)
            case Attachment():
                self.last_time_ns = max(self.last_time_ns, record.log_time)
            case Message():
                self.last_time_ns = max(self.last_time_ns, record.log_time)
        self.records += isinstance(record, Metadata | Message)

    @property
    def samples(self) -> int:
        """Samples in the file."""
        return self._sound.samples

    @property
    def next_sample(self) -> int:
        """Index after the last sample in the file."""
        return self._sound.next_sample


class Rewritten:
    """The recovered file."""

    def __init__(self, stream: BinaryIO, survey: Survey) -> None:
        header = survey.scan.header
        self._survey = survey
        self._writer = mcap_writer(stream)
        self._topics = Topics(self._writer, survey.run.get(AXIS_FACT, ""))
        self._names: dict[int, str] = {}
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self.samples = survey.samples
        self.added = 0
        self.missing = survey.next_sample - survey.samples
        self._last_time_ns = survey.last_time_ns
        self._writer.start(
            profile=header.profile if header else "",
            library=header.library if header else f"hilctl {__version__}",
        )

    def copy(self, records: Iterable[McapRecord]) -> None:
        """Copy all records except the facts of the end."""
        for record in records:
            self._record(record)
        self._topics.register()

    def _record(self, record: McapRecord) -> None:
        writer = self._writer
        match record:
            case Message():
                self._message(record)
            case Schema():
                self._schemas[record.id] = writer.register_schema(
                    record.name, record.encoding, record.data
                )
            case Channel():
                self._channel(record)
            # `finish` writes the end: added samples come before it, and its counters change.
            case Metadata() if record.name != "hilctl.end":
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                times = record.create_time, record.log_time
                writer.add_attachment(*times, record.name, record.media_type, record.data)

    def _channel(self, record: Channel) -> None:
        number = self._writer.register_channel(
            record.topic,
            record.message_encoding,
            self._schemas.get(record.schema_id, 0),
            record.metadata,
        )
        self._channels[record.id], self._names[record.id] = number, record.topic
        self._topics.know(record.topic, number, 0)

    def _message(self, record: Message) -> None:
        number = self._channels[record.channel_id]
        self._topics.know(self._names[record.channel_id], number, record.sequence + 1)
        self._writer.add_message(
            number, record.log_time, record.data, record.publish_time, record.sequence
        )

    def add(
        self, batches: Iterable[BlockBatch], events: Iterable[Event], layout: RecordingLayout
    ) -> None:
        """Add batches and events that are not in the original, in order."""
        maker = MessageMaker(layout)
        maker.samples = self.samples
        for batch in batches:
            for message in maker.batch(batch):
                self._topics.add(message)
                self._last_time_ns = max(self._last_time_ns, message.time_ns)
        for event in events:
            self._topics.add(maker.event(event))
        self.added = maker.samples - self.samples
        self.samples = maker.samples
        self.missing += maker.missing

    def finish(self, end: Mapping[str, str] | None, ended_at: int) -> str:
        """Write the end of the run and the index; return damage and losses in one line."""
        own = self._survey.end
        last = self.samples + self.missing - 1
        exchanged = _number(own, "recorded_samples") + _number(own, "missing_samples")
        self.missing = max(self.missing, ended_at - self.samples, exchanged - self.samples)
        known = bool(ended_at or exchanged)
        reason = self._reason(last, known=known)
        level = "info" if known and not self.missing else "warning"
        event = Event(max(0, last), level, "recovered", reason, time_ns=self._last_time_ns)
        self._topics.add(event_message(event))
        facts = own or end or {"code": "recovered", "reason": f"recovered: {reason}"}
        counted = {
            "recorded_samples": str(self.samples),
            "missing_samples": str(self.missing),
            "recovered": reason,
        }
        metadata = sealed("hilctl.end", {**facts, **counted})
        if not self._survey.end_is_right:  # a correct checksum would hide the damage
            metadata[CHECKSUM_FACT] = "wrong before recovery"
        self._writer.add_metadata("hilctl.end", metadata)
        self._writer.finish()
        return reason

    def _reason(self, last: int, *, known: bool) -> str:
        parts = [self._survey.scan.describe()]
        if self.added:
            parts.append(f"{self.added} samples added from the ring")
        if self.missing:
            parts.append(f"{self.missing} samples known to be missing")
        if not known:
            parts.append(f"the last sample is {last}" if self.samples else "no sample remains")
            parts.append(_UNKNOWN_END)
        elif not self.missing:
            parts.append("no sample is lost")
        return "; ".join(parts)


def _number(facts: Mapping[str, str], name: str) -> int:
    """Return a counter; 0 if it is missing or damaged."""
    try:
        return count_of(facts, name)
    except ValueError:
        return 0


@contextmanager
def _named_errors(path: Path, output: Path | None) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise DataError(f"{error.filename or path}: no such file or folder") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except FileExistsError:
        raise InputError(f"{output}: exists already: set another --output") from None
    except OSError as error:
        where = error.filename or path
        raise InputError(f"{where}: cannot be recovered: {reason(error)}") from None


def _plausible(event: Event) -> bool:
    """Return whether an event from memory has a possible sample and time."""
    return 0 <= event.sample < LAST_SAMPLE and 0 <= event.time_ns <= MAX_UNIX_NS


def recover_recording(
    path: Path,
    extra: Iterable[BlockBatch] = (),
    end: Mapping[str, str] | None = None,
    *,
    events: Sequence[Event] = (),
    ended_at: int = 0,
    output: Path | None = None,
) -> Recovered:
    """Repair a recording.

    The new file replaces the original, which is kept beside it as ``NAME.torn``, with a number if
    that exists. An intact file is not changed unless ``extra`` has more samples.

    Args:
        path: The recording; no run may be recording to it.
        extra: Batches that may not have been written, in order. Blocks that are in the file are
            omitted; gaps before the others count as dropped. A block is written as a whole.
        end: Facts of the run's end if the file has none, with ``code`` and ``reason``; by default
            the code is ``recovered``.
        events: Events of the loop that may not have been written; added with the batches.
        ended_at: Index after the last sample that was exchanged; 0 if unknown.
        output: Path of the new file; the original then stays in place.

    Raises:
        DataError: The file cannot be read, has nothing to recover, or lacks the facts needed to
            add ``extra``.
        InputError: It is being recorded, or the new file cannot be written. Nothing has changed.
    """
    with _named_errors(path, output), open_binary(path) as stream:
        lock(stream, shared=True)
        survey = Survey(stream)
        more = list(_not_in_file(extra, survey.next_sample))
        if not survey.scan.repairable and not more:
            return _left_alone(path, survey)
        layout = _check(survey, more)
        with closing(Replacement(path, output)) as replacement:
            saved = Rewritten(replacement.stream, survey)
            saved.copy(RecoveryScan(stream, MessageValidator()).records())
            if layout:
                saved.add(more, filter(_plausible, events), layout)
            ended = saved.finish(end, ended_at if ended_at < LAST_SAMPLE else 0)
            if not HAS_LOCKS:
                stream.close()
            kept = replacement.put()
    return Recovered(
        path=replacement.final,
        original=kept,
        reason=ended,
        samples=saved.samples,
        added_samples=saved.added,
        missing_samples=saved.missing,
        damages=tuple(survey.scan.damages),
    )


def _left_alone(path: Path, survey: Survey) -> Recovered:
    missing, damages = survey.next_sample - survey.samples, tuple(survey.scan.damages)
    text = "intact, nothing to repair"
    if damages:
        text = f"{survey.scan.describe()}; this damage cannot be repaired, the rest is intact"
    return Recovered(path, None, text, survey.samples, 0, missing, damages)


def _check(survey: Survey, more: list[BlockBatch]) -> RecordingLayout | None:
    """Reject a file with nothing to recover; return the layout of the samples to add, if any."""
    if not survey.records:
        raise DataError("contains no complete record: nothing to recover")
    if not more:
        return None
    try:
        return RecordingLayout.from_facts(survey.run)
    except DataError as error:
        raise DataError(f"samples cannot be added: {error}") from None


def _not_in_file(extra: Iterable[BlockBatch], next_sample: int) -> Iterator[BlockBatch]:
    """Yield the blocks from ``next_sample`` on, with new counts of the gaps before them.

    They come from the memory of a crashed process, so implausible blocks are omitted.
    """
    for batch in extra:
        firsts = batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist()
        sound = sound_blocks(batch)
        rows: list[int] = []
        gaps: list[int] = []
        for row, first in enumerate(firsts):
            if first >= next_sample and sound[row]:
                rows.append(row)
                gaps.append(first - next_sample)
                next_sample = first + batch.flags.shape[1]
        if rows:
            chosen = batch.rows(np.array(rows, dtype=np.int64))
            chosen.heads[:, BlockHeader.DROPPED_BEFORE] = gaps
            yield chosen
