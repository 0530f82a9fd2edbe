"""Survey a recording, sound or not, and save what it holds into a new file."""

from collections.abc import Iterable, Mapping
from typing import BinaryIO

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema

from hilctl import __version__
from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch
from hilctl.recording.encoder import MessageMaker, RecordingLayout, Topics, event_message
from hilctl.recording.metadata_keys import CHECKSUM_FACT, sealed, unsealed
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.validation import MessageValidator, count_of
from hilctl.recording.writer import mcap_writer

_UNKNOWN_END = (
    "what was exchanged after it is unknown: at most the last unflushed interval where hilctl was "
    "killed, perhaps more where the power failed"
)


class Survey:
    """What a file holds.

    Args:
        stream: The file.

    Attributes:
        scan: What is wrong with it.
        run: Facts of the run, empty where they are lost.
        end: Facts of its end, empty where they are lost or were never written.
        end_is_right: Whether their checksum is.
        last_time_ns: Unix time of the last message or attachment, in ns.
        records: Metadata and messages that are whole.

    Raises:
        OSError: The file can't be read.
        DataError: It asks for more work or memory than a recording of its size can.
    """

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
        """Samples in it."""
        return self._sound.samples

    @property
    def next_sample(self) -> int:
        """Index after the last sample in it."""
        return self._sound.next_sample


class Rewritten:
    """The sound file in the making.

    Args:
        stream: File to write.
        survey: What the old one holds.

    Attributes:
        samples: Samples in it.
        added: Those of them that the old file does not hold.
        missing: Samples known to be missing.
    """

    def __init__(self, stream: BinaryIO, survey: Survey) -> None:
        header = survey.scan.header
        self._survey = survey
        self._writer = mcap_writer(stream)
        self._topics = Topics(self._writer)
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
        """Copy all records but the facts of the end."""
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
            # The end is written anew: what is added comes before it, and its counters change.
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
        """Add batches and events that the old file does not hold, in order."""
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
        """Write an event, the facts of the end, index and footer.

        Args:
            end: Facts of the end, where the old file has none.
            ended_at: Index after the last sample that was exchanged; 0 where that is not known.

        Returns:
            What was wrong, and what is lost.
        """
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
        if not self._survey.end_is_right:  # a right checksum would hide it from all who come after
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
            parts.append(f"the last sample is {last}" if self.samples else "no sample is left")
            parts.append(_UNKNOWN_END)
        elif not self.missing:
            parts.append("no sample is lost")
        return "; ".join(parts)


def _number(facts: Mapping[str, str], name: str) -> int:
    """Return a counter, or 0 where there is none that can be read."""
    try:
        return count_of(facts, name)
    except ValueError:
        return 0
