"""Columns and flags of samples, and blocks of samples from the loop to the recorder.

The fields of :class:`Samples` define the columns of ring, messages, reader and export.
"""

from dataclasses import dataclass, field, fields, replace
from enum import IntEnum, IntFlag
from typing import Annotated, Literal, Self, TypeAlias, get_type_hints

import numpy as np
import numpy.typing as npt

from hilctl.base.types import F64, I64, U32, CommandUnit

LAST_SAMPLE = 2**40
"""Upper bound of sample indices: a hundred million, and a safe ramp of an hour at 1 MHz."""
LONGEST_NS = 2**60
"""Upper bound of the times of ticks since the computer started."""

WhenRecorded: TypeAlias = Literal["always", "measured", "own_input", "aged", "corrected"]
"""``measured``: if the device measures its command; ``own_input``: if the compensator's input
differs from the reference; ``aged``: if the sensor sends unasked; ``corrected``: if readings are
corrected by a calibration."""


@dataclass(frozen=True, slots=True)
class RecordedField:
    """The protobuf field of a column. Its numbers are never reused.

    Attributes:
        name: Name with unit; in events with the prefix ``before_``.
        block: Its number in ``hilctl.SampleBlock``.
        before: Its number in ``hilctl.Event``, for the samples before the event.
        scope: Its number in ``hilctl.Sample``; 0 if it has no such field.
    """

    name: str
    unit: str
    block: int
    before: int
    scope: int = 0


@dataclass(frozen=True, slots=True)
class SampleColumn:
    """A column with one float64 per sample.

    Attributes:
        recorded_as: Its field, for commands in volt unless ``recorded_in_v`` is set.
        recorded_in_v: Its field for commands in volt; None if its unit does not depend on them.
        when: Condition for recording it.
        otherwise: Column that it equals if not recorded; otherwise it is empty.
        answered: Whether the device returns it.
        in_waveform_unit: Whether the loop uses the waveform's unit; NaN is recorded unless that is
            um.
    """

    meaning: str
    recorded_as: RecordedField
    recorded_in_v: RecordedField | None = None
    when: WhenRecorded = "always"
    otherwise: str = ""
    answered: bool = False
    in_waveform_unit: bool = False

    def field(self, unit: CommandUnit) -> RecordedField:
        """Return its field in a recording whose commands are in ``unit``."""
        return self.recorded_as if unit == "A" else self.recorded_in_v or self.recorded_as


def _empty() -> F64:
    return np.empty(0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Samples in order; each array has one row per sample.

    Attributes:
        index: int64[n], sample index since the start of the run; a jump is a gap.
        flags: uint32[n], bits of :class:`Flag`.

    The columns are float64[n] each, commands in the command unit. A column that is neither recorded
    nor equal to another one is empty. Columns have the order of the rows of a block.
    """

    index: I64
    reference_um: Annotated[
        F64,
        SampleColumn(
            "requested displacement; NaN without one (current runs, ramp)",
            RecordedField("reference_um", "um", block=5, before=6, scope=3),
            in_waveform_unit=True,
        ),
    ]
    wanted: Annotated[
        F64,
        SampleColumn(
            "command before the limiter",
            RecordedField("wanted_a", "A", block=6, before=7, scope=4),
            RecordedField("wanted_v", "V", block=11, before=11, scope=8),
        ),
    ]
    command: Annotated[
        F64,
        SampleColumn(
            "applied command",
            RecordedField("current_a", "A", block=7, before=8, scope=5),
            RecordedField("drive_v", "V", block=12, before=12, scope=9),
        ),
    ]
    displacement_um: Annotated[
        F64,
        SampleColumn(
            "displacement, sampled when the command was applied",
            RecordedField("displacement_um", "um", block=8, before=9, scope=6),
            answered=True,
        ),
    ]
    measured: Annotated[
        F64,
        SampleColumn(
            "command as the device measured it",
            RecordedField("measured_a", "A", block=10, before=15),
            RecordedField("measured_v", "V", block=13, before=16),
            when="measured",
            answered=True,
        ),
    ] = field(default_factory=_empty)
    input_um: Annotated[
        F64,
        SampleColumn(
            "the compensator's input: the advanced reference plus its corrections",
            RecordedField("input_um", "um", block=16, before=17),
            when="own_input",
            otherwise="reference_um",
            in_waveform_unit=True,
        ),
    ]
    reading_age_s: Annotated[
        F64,
        SampleColumn(
            "time since the displacement arrived from a sensor that sends unasked; NaN before that",
            RecordedField("reading_age_s", "s", block=17, before=18),
            when="aged",
            answered=True,
        ),
    ] = field(default_factory=_empty)
    reading_um: Annotated[
        F64,
        SampleColumn(
            "displacement as the sensor read it, before the correction by its calibration",
            RecordedField("reading_um", "um", block=18, before=19),
            when="corrected",
            answered=True,
        ),
    ] = field(default_factory=_empty)
    aux: F64 = field(default_factory=lambda: np.empty((0, 0)))
    """Auxiliary channels, float64[n, k], the same for all samples of a block; empty without any."""
    flags: U32

    @classmethod
    def of(cls, index: I64, values: F64, flags: U32) -> Self:
        """Return samples by the rows of a block's columns, float64[len(COLUMNS), n], not copied."""
        return cls(index=index, flags=flags, **dict(zip(COLUMNS, values, strict=True)))

    def column(self, name: str) -> F64:
        """Return one column."""
        values: F64 = getattr(self, name)
        return values

    def columns(self) -> dict[str, F64]:
        """Return the columns by name, in order."""
        return {name: getattr(self, name) for name in COLUMNS}

    def rows(self, chosen: slice | npt.NDArray[np.bool_] | I64) -> Self:
        """Return some rows of every column."""
        columns = {
            name: values[chosen] if values.size else values
            for name, values in self.columns().items()
        }
        columns["aux"] = self.aux[chosen] if self.aux.size else self.aux
        return replace(self, index=self.index[chosen], flags=self.flags[chosen], **columns)

    def part(self, start: int, stop: int) -> Self:
        """Return the rows whose sample index lies in [start, stop)."""
        low, high = np.searchsorted(self.index, (start, stop))
        return self.rows(slice(int(low), int(high)))

    def followed_by(self, later: "Samples") -> "Samples":
        """Return these rows followed by others."""
        names = [each.name for each in fields(self)]
        return Samples(
            **{name: np.concatenate((getattr(self, name), getattr(later, name))) for name in names}
        )


COLUMNS: dict[str, SampleColumn] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Samples, include_extras=True).items()
    if hasattr(hint, "__metadata__")
}
"""The columns by name, in the order of the rows of a block's columns."""
RECORDED_FIELDS = tuple(
    dict.fromkeys(each.field(unit) for each in COLUMNS.values() for unit in ("A", "V"))
)
"""The fields of all columns, whatever the unit of the commands."""
_ROW = {name: row for row, name in enumerate(COLUMNS)}
ANSWERS = [row for row, each in enumerate(COLUMNS.values()) if each.answered]
"""Rows of a block's columns that the device fills."""
_ALL = slice(None)


class BlockHeader(IntEnum):
    """Header of a block, int64 each."""

    SEQUENCE = 0
    FIRST_SAMPLE = 1
    SAMPLES = 2
    DROPPED_BEFORE = 3
    DEADLINE_NS = 4
    LATE_NS = 5
    EXCHANGE_NS = 6


@dataclass(frozen=True, slots=True)
class BlockBatch:
    """k blocks with B samples each.

    Attributes:
        heads: int64[k, len(Head)].
        states: float64[k, s]: the compensator's memory before each block, then the command
            before it.
        columns: float64[k, len(COLUMNS), B], see :data:`COLUMNS`.
        flags: uint32[k, B].
        aux: float64[k, a], the value of each auxiliary channel of the device.
    """

    heads: I64
    states: F64
    columns: F64
    flags: U32
    aux: F64

    @classmethod
    def empty(cls, blocks: int, block: int, state_size: int, aux: int = 0) -> "BlockBatch":
        """Return an empty batch in the memory of this process."""
        return cls(
            np.zeros((blocks, len(BlockHeader)), dtype=np.int64),
            np.zeros((blocks, state_size)),
            np.full((blocks, len(COLUMNS), block), np.nan),
            np.zeros((blocks, block), dtype=np.uint32),
            np.full((blocks, aux), np.nan),
        )

    def rows(self, chosen: slice | I64) -> "BlockBatch":
        """Return a copy of some blocks."""
        return BlockBatch(
            self.heads[chosen].copy(),
            self.states[chosen].copy(),
            self.columns[chosen].copy(),
            self.flags[chosen].copy(),
            self.aux[chosen].copy(),
        )

    def samples(self, blocks: slice = _ALL) -> Samples:
        """Return the samples of some blocks, one after the other."""
        values = self.columns[blocks].transpose(1, 0, 2).reshape(len(COLUMNS), -1)
        samples = Samples.of(self.index(blocks), values, self.flags[blocks].ravel())
        if not self.aux.size:
            return samples
        return replace(samples, aux=self.aux[blocks].repeat(self.flags.shape[1], axis=0))

    def clear_answers(self, blocks: slice | I64) -> None:
        """Set all rows that the device fills to NaN."""
        for row in ANSWERS:
            self.columns[blocks, row] = np.nan
        self.aux[blocks] = np.nan

    def index(self, blocks: slice = _ALL) -> I64:
        """Return the sample indices of some blocks, one after the other."""
        firsts = self.heads[blocks, BlockHeader.FIRST_SAMPLE]
        index: I64 = (firsts[:, None] + np.arange(self.flags.shape[1])).ravel()
        return index

    def column(self, name: str) -> F64:
        """Return one column, one sample after the other."""
        return self.columns[:, _ROW[name]].ravel()


class Flag(IntFlag):
    """Bits of a sample's ``flags``; those from 64 on belong to the interlocks of the loop."""

    RANGE_LIMITED = 1
    """The requested command was outside the range of the limits."""
    SLEW_LIMITED = 2
    """The requested command exceeded the slew limit."""
    INVALID = 4
    """The requested command was not finite; the last command was kept."""
    RAMP = 8
    """A ramp to the safe value, before the waveform or after it, which has no reference."""
    SENSOR_INVALID = 16
    """The displacement was not finite, outside the stroke limits or at an end of the sensor."""
    UNANSWERED = 32
    """The device did not answer the exchange: the command may not have reached it."""
    CONDITION = 1 << 17
    """A sample of the conditioning before the waveform (cycle or rest), without a reference."""
    AFTER_SKIPPED = 1 << 16
    """In the first block after skipped ticks, in which the output was constant."""
    INVERSE_OUT = 1 << 18
    """The inverse was bypassed, partly or completely, by a line."""
    TRIGGER = 1 << 19
    """The digital output was set with this sample, because a mark of the waveform is due."""
    ON_TARGET = 1 << 20
    """The displacement had been within the tolerance of ``on_target`` for long enough."""


NO_WAVEFORM = Flag.RAMP | Flag.CONDITION
"""Samples outside the waveform, without a reference and metrics."""
