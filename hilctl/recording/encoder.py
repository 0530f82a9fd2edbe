"""Encoder of ring batches and events as messages of a recording's topics."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import repeat
from typing import NamedTuple, Self

import numpy as np
from mcap.writer import Writer
from pydantic import TypeAdapter, ValidationError

from hilctl.base.errors import DataError, InputError
from hilctl.base.events import Event
from hilctl.base.samples import (
    COLUMNS,
    BlockBatch,
    BlockHeader,
    RecordedField,
    SampleColumn,
    Samples,
)
from hilctl.base.strict import first_problem
from hilctl.base.types import F64, I64, U32, CommandUnit
from hilctl.recording import schema
from hilctl.recording.codec import BlockArrays, encode_block, encode_scope, encode_ticks
from hilctl.recording.recording import TICK_COLUMNS
from hilctl.recording.validation import MAX_UNIX_NS, RATES_HZ

_MAX_BLOCK = 1000
_NONE = np.empty(0)
_TICK_HEADS = {name: int(BlockHeader[name.upper()]) for name in TICK_COLUMNS}
_YEAR_NS = 366 * 86_400 * 10**9


class Encoded(NamedTuple):
    """One message: topic without axis, Unix time in ns, bytes."""

    topic: str
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RecordingLayout:
    """Parameters of the messages, stored in a recording's facts so that recovery can add messages.

    Attributes:
        scope_rate_hz: Highest rate of ``/scope``.
        start_unix_ns: Unix time of sample 0 in ns.
        records_input: Whether the compensator's input differs from the reference.
        ages_readings: Whether the sensor sends without a request, so that its readings have an age.
        waveform_unit: ``um``, or the command unit without a compensator.
        corrects_readings: Whether displacements are corrected by a calibration.
    """

    sample_rate_hz: float
    command_unit: CommandUnit
    measures_command: bool
    scope_rate_hz: float
    start_unix_ns: int
    records_input: bool = False
    waveform_unit: str = "um"
    ages_readings: bool = False
    corrects_readings: bool = False

    def __post_init__(self) -> None:
        """Check rates and clock; times in ns exceed 64 bits after 2260."""
        if not RATES_HZ[0] <= self.sample_rate_hz <= RATES_HZ[1] or not self.scope_rate_hz > 0.0:
            rates = f"{self.sample_rate_hz!r}, {self.scope_rate_hz!r}"
            raise InputError(f"sample_rate_hz and scope_rate_hz must be rates: {rates}")
        if not 0 <= self.start_unix_ns <= MAX_UNIX_NS - _YEAR_NS:
            seconds = f"{self.start_unix_ns * 1e-9:.0f} s from 1970 on"
            raise InputError(
                f"the clock must be between 1970 and 2261 for a recording (got {seconds}): "
                "set the computer's clock"
            )

    def records(self, column: SampleColumn) -> bool:
        """Return whether a column is recorded."""
        given = {
            "measured": self.measures_command,
            "own_input": self.records_input,
            "aged": self.ages_readings,
            "corrected": self.corrects_readings,
        }
        return given.get(column.when, True)

    def recorded(self, samples: Samples | BlockBatch) -> Iterator[tuple[RecordedField, F64]]:
        """Yield field and values of each recorded column."""
        for name, column in COLUMNS.items():
            if self.records(column):
                values = samples.column(name)
                elsewhere = column.in_waveform_unit and self.waveform_unit != "um"
                known = np.full_like(values, np.nan) if elsewhere else values
                yield column.field(self.command_unit), known

    def time_ns(self, sample: int) -> int:
        """Return the Unix time at which a sample was due, in ns."""
        return self.start_unix_ns + round(sample * 1e9 / self.sample_rate_hz)

    def times_ns(self, samples: I64) -> I64:
        """Return :meth:`time_ns` of each sample: int64[n]."""
        since_ns: I64 = np.rint(samples * 1e9 / self.sample_rate_hz).astype(np.int64)
        return self.start_unix_ns + since_ns

    def to_facts(self) -> dict[str, str]:
        """Return the fields as text, for a recording's metadata."""
        fields = asdict(self).items()
        return {
            name: each if isinstance(each, str) else repr(each).lower() for name, each in fields
        }

    @classmethod
    def from_facts(cls, facts: Mapping[str, str]) -> Self:
        """Return the layout in a recording's facts; raise DataError if these are incomplete."""
        try:
            return TypeAdapter(cls).validate_strings(facts)
        except ValidationError as error:
            problem = first_problem(error)
        except InputError as error:
            problem = str(error)
        raise DataError(f"metadata hilctl.run: missing or damaged: {problem}")


def event_message(event: Event, before: Iterable[tuple[RecordedField, F64]] = ()) -> Encoded:
    """Return the message of an event with its time and the preceding samples by field."""
    out = schema.message_class("Event")()
    for name in ("sample", "level", "code", "text"):
        setattr(out, name, getattr(event, name))
    out.value_names.extend(event.values.keys())
    out.values.extend(event.values.values())
    if event.before is not None:
        out.before_sample.extend(event.before.index.tolist())
        out.before_flags.extend(event.before.flags.tolist())
    for field, values in before:
        getattr(out, f"before_{field.name}").extend(values.tolist())
    return Encoded("/events", event.time_ns, out.SerializeToString())


class MessageMaker:
    """Encoder of one run; counts samples and missing samples."""

    def __init__(self, layout: RecordingLayout) -> None:
        self._layout = layout
        self._stride = max(1, int(np.ceil(layout.sample_rate_hz / layout.scope_rate_hz)))
        self.samples = 0
        self.missing = 0

    def event(self, event: Event) -> Encoded:
        """Return the message of one event."""
        if not event.time_ns:
            event = replace(event, time_ns=self._layout.time_ns(event.sample))
        before = self._layout.recorded(event.before) if event.before is not None else ()
        return event_message(event, before)

    def batch(self, batch: BlockBatch) -> Iterator[Encoded]:
        """Yield the messages of all samples and ticks of a batch."""
        gaps = batch.heads[:, BlockHeader.DROPPED_BEFORE].tolist()
        block = batch.flags.shape[1]
        largest = max(1, _MAX_BLOCK // block)
        index, flags = batch.index(), batch.flags.ravel()
        columns = list(self._layout.recorded(batch))
        t_rel = index / self._layout.sample_rate_hz
        row, on_grid = 0, []
        while row < len(gaps):
            stop = row + 1
            while stop < len(gaps) and stop - row < largest and gaps[stop] == 0:
                stop += 1
            part = slice(row * block, stop * block)
            cut = {field.name: values[part] for field, values in columns}
            yield self._block(batch, slice(row, stop), flags[part], cut, t_rel[part])
            first = part.start + -int(index[part.start]) % self._stride
            on_grid.append(np.arange(first, part.stop, self._stride))
            row = stop
        shown = np.concatenate(on_grid)
        if shown.size:
            scope = {field.name: values[shown] for field, values in columns if field.scope}
            messages = encode_scope(index[shown], flags[shown], {"t_rel": t_rel[shown], **scope})
            times_ns = self._layout.times_ns(index[shown]).tolist()
            yield from map(Encoded, repeat("/scope"), times_ns, messages)
        yield self._ticks(batch)

    def _block(
        self, batch: BlockBatch, rows: slice, flags: U32, columns: dict[str, F64], t_rel: F64
    ) -> Encoded:
        row = rows.start
        first = int(batch.heads[row, BlockHeader.FIRST_SAMPLE])
        dropped = int(batch.heads[row, BlockHeader.DROPPED_BEFORE])
        begins = self.samples == 0 or bool(dropped)
        state = batch.states[row] if begins else _NONE
        block = BlockArrays(
            tick0=first,
            n=flags.size,
            dropped=dropped,
            flags=flags,
            columns=columns,
            state=state[:-1],
            previous_command=state[-1:],
            aux=batch.aux[rows],
        )
        self.samples += flags.size
        self.missing += dropped
        return Encoded("/samples", self._layout.time_ns(first), encode_block(block, t_rel))

    def _ticks(self, batch: BlockBatch) -> Encoded:
        columns = {name: batch.heads[:, column] for name, column in _TICK_HEADS.items()}
        first = int(batch.heads[0, BlockHeader.FIRST_SAMPLE])
        return Encoded("/ticks", self._layout.time_ns(first), encode_ticks(columns))


class Topics:
    """Channels of a file: adds messages to the topics of an axis and numbers them."""

    def __init__(self, writer: Writer, axis: str) -> None:
        self._writer = writer
        self._names = {topic: schema.topic_of(axis, topic) for topic in schema.TOPICS}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def know(self, topic: str, channel: int, sequence: int) -> None:
        """Continue a channel of the file; its next message gets the number ``sequence``."""
        self._channels[topic], self._sequence[topic] = channel, sequence

    def register(self) -> None:
        """Register the topics of hilctl that are not in the file yet."""
        descriptors = schema.descriptor_set()
        for topic, name in schema.TOPICS.items():
            named = self._names[topic]
            if named not in self._channels:
                number = self._writer.register_schema(f"hilctl.{name}", "protobuf", descriptors)
                self.know(named, self._writer.register_channel(named, "protobuf", number), 0)

    def add(self, message: Encoded) -> None:
        """Write one message."""
        name = self._names[message.topic]
        channel, number = self._channels[name], self._sequence[name]
        time_ns = message.time_ns
        self._writer.add_message(channel, time_ns, message.data, time_ns, number)
        self._sequence[name] += 1
