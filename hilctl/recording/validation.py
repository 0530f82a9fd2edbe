"""Checks of the facts, segments and messages of a recording; compiled kernels rely on them.

A check of a message returns the problem, or an empty text. On a problem the reader rejects the file
and recovery omits the message.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError
from mcap.records import Channel, McapRecord, Message, Schema
from pydantic import TypeAdapter, ValidationError

from hilctl.base.device import AuxChannel
from hilctl.base.errors import DataError, InputError
from hilctl.base.events import CHANGES, INVERSE
from hilctl.base.samples import (
    COLUMNS,
    LAST_SAMPLE,
    LONGEST_NS,
    RECORDED_FIELDS,
    BlockBatch,
    BlockHeader,
)
from hilctl.base.segments import SHORTEST_PERIOD, Segment
from hilctl.base.strict import StrictModel, first_problem
from hilctl.base.types import CommandUnit
from hilctl.recording import schema
from hilctl.recording.codec import BlockArrays, decode_block, decode_ticks
from hilctl.recording.metadata_keys import AUX_FACT, LABELS_FACT, LabelValue
from hilctl.recording.recording import TICK_COLUMNS, Ticks

MAX_UNIX_NS = 2**63 - 1
"""Latest time of a signed 64-bit integer: in the year 2262."""
RATES_HZ = (1e-6, 1e9)
"""Lowest and highest sample rate."""

_MOST_VALUES = 1000
_MOST_TEXT = 2**24
_UNITS: tuple[CommandUnit, ...] = ("A", "V")
_MOST_DIGITS = 15
_LINE = 60
_STRICT = StrictModel.model_config
_LABELS = TypeAdapter(dict[str, LabelValue], config=_STRICT)
_AUX = TypeAdapter(tuple[AuxChannel, ...])
_SEGMENTS = TypeAdapter(tuple[Segment, ...], config=_STRICT)


_DECODERS: dict[str, Callable[[bytes], Any]] = {
    "/samples": decode_block,
    "/ticks": decode_ticks,
    "/scope": schema.message_class("Sample").FromString,
    "/events": schema.message_class("Event").FromString,
}


def decode(topic: str, data: bytes) -> tuple[Any, str]:
    """Decode a message of a topic of hilctl; also return the problem, if any."""
    try:
        return _DECODERS[topic](data), ""
    except (DecodeError, ValueError) as error:
        return None, f"cannot be decoded: {error}"


def block_problem(block: BlockArrays, next_sample: int) -> str:
    """Check samples that follow the sample before ``next_sample``."""
    if not block.n:
        return "holds no sample"
    if not next_sample <= block.tick0 < LAST_SAMPLE:
        return f"sample {block.tick0} cannot follow sample {next_sample - 1}"
    lengths = {name: values.size for name, values in block.columns.items()}
    lengths["flags"] = block.flags.size
    # A million samples are thousands of blocks, all with the same columns.
    complete = set(lengths.values()) == {block.n} and has_all(tuple(lengths))
    if not complete and (wrong := _wrong_lengths(lengths, "", block.n)):
        return f"{block.n} samples with {wrong}"
    before = block.previous_command
    if before.size > 1 or not np.isfinite(before).all():
        return "previous_command must be one finite number"
    return ""


@cache
def has_all(names: tuple[str, ...]) -> bool:
    """Return whether the fields of the complete columns include all required ones."""
    return not _wrong_lengths(dict.fromkeys(names, 1), "", 1)


def _wrong_lengths(found: Mapping[str, int], prefix: str, samples: int) -> str:
    """Return the columns of a message that do not have one value per sample."""
    lengths = {f"{prefix}flags": found.get(f"{prefix}flags", 0)}
    for column in COLUMNS.values():
        names = sorted({prefix + column.field(unit).name for unit in _UNITS})
        filled = {name: found[name] for name in names if found.get(name)}
        missing = {" or ".join(names): 0} if column.when == "always" else {}
        lengths |= filled or missing
    return _listed({name: length for name, length in lengths.items() if length != samples})


def ticks_problem(ticks: Ticks) -> str:
    """Check the content of a ``TickBlock``."""
    columns = {name: getattr(ticks, name) for name in TICK_COLUMNS}
    lengths = {name: values.size for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        return "its columns differ in length: " + _listed(lengths)
    if not ticks.first_sample.size:
        return ""
    if ticks.first_sample.max() >= LAST_SAMPLE:
        return f"sample {ticks.first_sample.max()} is beyond any run"
    for name in TICK_COLUMNS[1:]:
        # The lowest integer has no magnitude.
        lowest, highest = int(columns[name].min()), int(columns[name].max())
        if max(-lowest, highest) > LONGEST_NS:
            return f"{name} of {max(-lowest, highest)} ns is longer than a run can be"
    return ""


def event_problem(event: Any, time_ns: int) -> str:
    """Check an ``Event`` and its log time."""
    names, values = len(event.value_names), len(event.values)
    if names != values or names > _MOST_VALUES:
        return f"{names} names for {values} values"
    if not 0 <= time_ns <= MAX_UNIX_NS:
        return f"its time, {time_ns} ns, is beyond the year 2262"
    if max(event.sample, *event.before_sample, 0) >= LAST_SAMPLE:
        return "a sample is beyond any run"
    # The replay uses the number of samples that a change takes.
    if event.code in CHANGES and not all(0.0 <= abs(value) < LAST_SAMPLE for value in event.values):
        return f"a change of the reference by {list(event.values)}"
    if event.code == INVERSE and not _is_fade(event):
        return f"a change of the inverse by {list(event.values)}"
    before = len(event.before_sample)
    if before and (wrong := _wrong_lengths(_lengths_before(event), "before_", before)):
        return f"{before} samples before it with {wrong}"
    return ""


def _lengths_before(event: Any) -> dict[str, int]:
    names = ["before_flags", *(f"before_{field.name}" for field in RECORDED_FIELDS)]
    return {name: len(getattr(event, name)) for name in names}


def _is_fade(event: Any) -> bool:
    """Return whether an event describes a crossfade that a replay can repeat."""
    values = dict(zip(event.value_names, event.values, strict=True))
    whole = values.keys() >= {"share", "samples", "slope", "at_zero"}
    return whole and 0.0 <= values["share"] <= 1.0 and values["samples"] >= 1.0


def sound_blocks(batch: BlockBatch) -> npt.NDArray[np.bool_]:
    """Return which blocks of a batch are plausible: bool[k]."""
    first = batch.heads[:, BlockHeader.FIRST_SAMPLE]
    times = batch.heads[:, [BlockHeader.DEADLINE_NS, BlockHeader.LATE_NS, BlockHeader.EXCHANGE_NS]]
    in_time = ((times >= -LONGEST_NS) & (times <= LONGEST_NS)).all(axis=1)
    in_run = (first >= 0) & (first < LAST_SAMPLE - batch.flags.shape[1])
    begun = np.isfinite(batch.states[:, -1])
    return np.asarray(in_time & in_run & begun)


def _listed(lengths: Mapping[str, int]) -> str:
    return ", ".join(f"{length} of {name}" for name, length in lengths.items())


class MessageValidator:
    """Validator of a file's messages in the topics of hilctl, in order."""

    def __init__(self) -> None:
        self._schemas: dict[int, str] = {}
        self._topics: dict[int, str] = {}
        self._refused: dict[int, str] = {}
        self._axis: str | None = None
        self.next_sample = 0
        """Index after the last sample of the valid messages."""
        self.samples = 0
        """Samples in valid messages."""

    def topic(self, channel: int) -> str:
        """Return the topic of a channel without its axis; empty if it is not one of hilctl."""
        return self._topics.get(channel, "")

    def problem(self, record: McapRecord) -> str:
        """Return why hilctl cannot have written a record, or an empty text."""
        match record:
            case Schema():
                self._schemas[record.id] = record.name
            case Channel():
                self._channel(record)
                return self._refused.get(record.id, "")
            case Message() if record.channel_id in self._refused:
                return self._refused[record.channel_id]
            case Message() if self.topic(record.channel_id):
                return self.decoded(record)[1]
        return ""

    def _channel(self, channel: Channel) -> None:
        self._topics.pop(channel.id, None)
        self._refused.pop(channel.id, None)
        axis, topic = schema.split_topic(channel.topic)
        if topic not in schema.TOPICS:
            return
        own = f"hilctl.{schema.TOPICS[topic]}"
        name = self._schemas.get(channel.schema_id, "")
        if name != own or channel.message_encoding != "protobuf":
            if not axis:  # with another first part it may be a topic of another program
                text = f"{channel.topic}: must hold {own} in protobuf, got {short(name)}"
                self._refused[channel.id] = text
        elif self._axis not in {None, axis}:
            text = f"{channel.topic}: a recording has one axis, and the file has several"
            self._refused[channel.id] = text
        else:
            self._axis = axis
            self._topics[channel.id] = topic

    def decoded(self, record: Message) -> tuple[Any, str]:
        """Return a decoded message of a topic of hilctl, and its problem, if any."""
        topic = self._topics[record.channel_id]
        if topic == "/scope":  # a copy of /samples, not read here
            return None, ""
        message, problem = decode(topic, record.data)
        if not problem:
            if topic == "/samples":
                problem = block_problem(message, self.next_sample)
            elif topic == "/ticks":
                problem = ticks_problem(message)
            else:
                problem = event_problem(message, record.log_time)
        if topic == "/samples" and not problem:
            self.next_sample = message.tick0 + message.n
            self.samples += message.n
        return message, f"{topic}: {problem}" if problem else ""


def labels_of(facts: Mapping[str, str]) -> dict[str, LabelValue]:
    """Return the labels of a run, if any; raise ValueError unless texts and finite numbers."""
    text = facts.get(LABELS_FACT, "{}")
    try:
        return _LABELS.validate_json(text)
    except ValidationError:
        rule = f"{LABELS_FACT} must be texts and numbers by name"
        raise ValueError(f"{rule}, got {short(text)}") from None


def aux_channels_of(facts: Mapping[str, str]) -> tuple[AuxChannel, ...]:
    """Return the auxiliary channels of a run, if any; raise DataError if they are damaged."""
    text = facts.get(AUX_FACT, "[]")
    try:
        return _AUX.validate_json(text)
    except (ValidationError, InputError):
        rule = f"{AUX_FACT} must be a list of channels"
        raise DataError(f"metadata hilctl.run: {rule}, got {short(text)}") from None


def number_of(facts: Mapping[str, str], name: str, low: float, high: float) -> float:
    """Return a number; raise ValueError if it is missing or outside ``low`` to ``high``."""
    if name not in facts:
        raise ValueError(f"{name} is missing")
    text = facts[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {short(text)}")
    return value


def count_of(facts: Mapping[str, str], name: str) -> int:
    """Return a count of samples, 0 if missing; raise ValueError if it is not a whole number."""
    text = facts.get(name, "0")
    if not (text.isascii() and text.isdecimal() and len(text) <= _MOST_DIGITS):
        raise ValueError(f"{name} must be a whole number, got {short(text)}")
    return int(text)


def short(text: str) -> str:
    """Return a text from a file, quoted and shortened to one line."""
    return repr(text if len(text) <= _LINE else text[: _LINE - 3] + "...")


def segments_of(text: str) -> tuple[Segment, ...]:
    """Return the segments of a run from their JSON text; raise ValueError if they are invalid."""
    if len(text) > _MOST_TEXT:
        raise ValueError(f"segments: {len(text)} characters are more than a run can have")
    try:
        segments = _SEGMENTS.validate_json(text)
    except ValidationError as error:
        raise ValueError(f"segments: {first_problem(error, 'the text')}") from None
    end = 0
    for number, each in enumerate(segments):
        places = [end, each.start, each.steady_start, each.steady_stop, each.stop, LAST_SAMPLE - 1]
        if places != sorted(places):
            rule = "sample indices must follow the previous segment and rise"
            raise ValueError(f"segments: {number}: {rule}: {places}")
        if each.period and each.period < SHORTEST_PERIOD:
            rule = f"period must be 0 or >= {SHORTEST_PERIOD:g} samples"
            raise ValueError(f"segments: {number}: {rule}: {each.period!r}")
        end = each.stop
    return segments
