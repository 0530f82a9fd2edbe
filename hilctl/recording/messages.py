"""From ring batches and events to the messages of a recording's topics."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from mcap.writer import Writer

from hilctl.base.arrays import F64, U32
from hilctl.base.device import CommandUnit
from hilctl.base.errors import DataError
from hilctl.base.samples import COLUMNS, Batch, Head
from hilctl.recording import schema
from hilctl.recording.data import Event

_COLUMNS = {
    "A": ("wanted_a", "current_a", "measured_a"),
    "V": ("wanted_v", "drive_v", "measured_v"),
}
_MAX_BLOCK = 500


class Encoded(NamedTuple):
    """One message: its topic, its Unix time in ns, its bytes."""

    topic: str
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Layout:
    """What messages are made by; a recording's facts say it, so that more can be made later.

    Attributes:
        sample_rate_hz: Samples a second.
        command_unit: ``A`` or ``V``.
        measures_command: Whether the device measures its command.
        scope_rate_hz: Highest rate of ``/scope``.
        start_unix_ns: Unix time of sample 0 in ns.
        records_input: Whether the compensator's input is other than the reference.
    """

    sample_rate_hz: float
    command_unit: CommandUnit
    measures_command: bool
    scope_rate_hz: float
    start_unix_ns: int
    records_input: bool = False

    def to_facts(self) -> dict[str, str]:
        """Return the fields as text, for a recording's metadata."""
        return {
            "sample_rate_hz": repr(self.sample_rate_hz),
            "command_unit": self.command_unit,
            "measures_command": str(self.measures_command).lower(),
            "records_input": str(self.records_input).lower(),
            "scope_rate_hz": repr(self.scope_rate_hz),
            "start_unix_ns": str(self.start_unix_ns),
        }

    @classmethod
    def from_facts(cls, facts: Mapping[str, str]) -> Self:
        """Undo :meth:`to_facts`.

        Raises:
            DataError: A fact is missing, as in recordings of an older hilctl, or damaged.
        """
        try:
            return cls(
                sample_rate_hz=float(facts["sample_rate_hz"]),
                command_unit="V" if facts["command_unit"] == "V" else "A",
                measures_command=facts["measures_command"] == "true",
                records_input=facts.get("records_input") == "true",  # older recordings have none
                scope_rate_hz=float(facts["scope_rate_hz"]),
                start_unix_ns=int(facts["start_unix_ns"]),
            )
        except (KeyError, ValueError) as error:
            raise DataError(f"metadata hilctl.run: missing or damaged: {error}") from None


class MessageMaker:
    """Makes the messages of one run.

    Args:
        layout: What they are made by.

    Attributes:
        samples: Samples made into messages so far.
        missing: Samples known to be missing between them.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._stride = max(1, int(np.ceil(layout.sample_rate_hz / layout.scope_rate_hz)))
        self.samples = 0
        self.missing = 0

    @staticmethod
    def event(event: Event, unit: CommandUnit = "A") -> Encoded:
        """Return the message of one event; ``unit`` is that of the commands told with it."""
        out = schema.message("Event")
        out.sample, out.level, out.code, out.text = (
            event.sample,
            event.level,
            event.code,
            event.text,
        )
        if event.before is not None:
            wanted, command, _ = _COLUMNS[unit]
            before = event.before
            out.before_sample.extend(before.index.tolist())
            out.before_reference_um.extend(before.reference_um.tolist())
            getattr(out, f"before_{wanted}").extend(before.wanted.tolist())
            getattr(out, f"before_{command}").extend(before.command.tolist())
            out.before_displacement_um.extend(before.displacement_um.tolist())
            out.before_flags.extend(before.flags.tolist())
        return Encoded("/events", event.time_ns, out.SerializeToString())

    def batch(self, batch: Batch) -> Iterator[Encoded]:
        """Yield the messages of all samples and ticks of a batch."""
        firsts = batch.heads[:, Head.FIRST_SAMPLE]
        gaps = batch.heads[:, Head.DROPPED_BEFORE]
        block = batch.flags.shape[1]
        largest = max(1, _MAX_BLOCK // block)
        row = 0
        while row < firsts.size:
            stop = row + 1
            while stop < firsts.size and stop - row < largest and gaps[stop] == 0:
                stop += 1
            yield from self._block(batch, row, stop)
            row = stop
        yield self._ticks(batch)

    def _block(self, batch: Batch, row: int, stop: int) -> Iterator[Encoded]:
        rows = slice(row, stop)
        first = int(batch.heads[row, Head.FIRST_SAMPLE])
        flags = batch.flags[rows].ravel()
        columns = batch.columns[rows].transpose(1, 0, 2).reshape(len(COLUMNS), -1)
        dropped = int(batch.heads[row, Head.DROPPED_BEFORE])
        t_rel = (first + np.arange(flags.size)) / self._layout.sample_rate_hz
        wanted, command, measured = _COLUMNS[self._layout.command_unit]
        out = schema.message("SampleBlock")
        out.tick0, out.n, out.dropped = first, flags.size, dropped
        out.t_rel.extend(t_rel.tolist())
        out.flags.extend(flags.tolist())
        out.reference_um.extend(columns[0].tolist())
        getattr(out, wanted).extend(columns[1].tolist())
        getattr(out, command).extend(columns[2].tolist())
        out.displacement_um.extend(columns[3].tolist())
        if self._layout.measures_command:
            getattr(out, measured).extend(columns[4].tolist())
        if self._layout.records_input:
            out.input_um.extend(columns[5].tolist())
        if self.samples == 0 or dropped:
            out.state.extend(batch.states[row, :-1].tolist())
            out.previous_command.append(float(batch.states[row, -1]))
        yield Encoded("/samples", self._time_ns(first), out.SerializeToString())
        self.samples += flags.size
        self.missing += dropped
        yield from self._scope(first, t_rel, columns, flags)

    def _scope(self, first: int, t_rel: F64, columns: F64, flags: U32) -> Iterator[Encoded]:
        wanted, command, _ = _COLUMNS[self._layout.command_unit]
        for k in range(-first % self._stride, flags.size, self._stride):
            out = schema.message("Sample")
            out.sample, out.t_rel, out.flags = first + k, t_rel[k], int(flags[k])
            out.reference_um, out.displacement_um = columns[0, k], columns[3, k]
            setattr(out, wanted, columns[1, k])
            setattr(out, command, columns[2, k])
            yield Encoded("/scope", self._time_ns(first + k), out.SerializeToString())

    def _ticks(self, batch: Batch) -> Encoded:
        out = schema.message("TickBlock")
        heads = batch.heads
        out.first_sample.extend(heads[:, Head.FIRST_SAMPLE].tolist())
        out.deadline_ns.extend(heads[:, Head.DEADLINE_NS].tolist())
        out.late_ns.extend(heads[:, Head.LATE_NS].tolist())
        out.exchange_ns.extend(heads[:, Head.EXCHANGE_NS].tolist())
        first = int(heads[0, Head.FIRST_SAMPLE])
        return Encoded("/ticks", self._time_ns(first), out.SerializeToString())

    def _time_ns(self, sample: int) -> int:
        return self._layout.start_unix_ns + round(sample * 1e9 / self._layout.sample_rate_hz)


class Topics:
    """Puts messages into a file under their topics, and numbers them.

    Args:
        writer: File to write to.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def know(self, topic: str, channel: int, sequence: int) -> None:
        """Go on with a channel that is in the file already.

        Args:
            topic: Its topic.
            channel: Its id in the file.
            sequence: Number of its next message.
        """
        self._channels[topic], self._sequence[topic] = channel, sequence

    def register(self) -> None:
        """Enter all of hilctl's topics that the file has not yet."""
        descriptors = schema.descriptor_set()
        for topic, name in schema.TOPICS.items():
            if topic not in self._channels:
                number = self._writer.register_schema(f"hilctl.{name}", "protobuf", descriptors)
                self.know(topic, self._writer.register_channel(topic, "protobuf", number), 0)

    def add(self, message: Encoded) -> None:
        """Write one message."""
        self._writer.add_message(
            self._channels[message.topic],
            log_time=message.time_ns,
            data=message.data,
            publish_time=message.time_ns,
            sequence=self._sequence[message.topic],
        )
        self._sequence[message.topic] += 1
