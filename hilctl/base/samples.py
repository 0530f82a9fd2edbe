"""What a sample is: its columns, its flags, and blocks of samples from the loop to the recorder."""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np

from hilctl.base.arrays import F64, I64, U32

COLUMNS = ("reference", "wanted", "command", "displacement_um", "measured", "input_um")
"""Rows of a block's columns; ``input_um`` is of no meaning where the reference is the input."""
ANSWERS = slice(COLUMNS.index("displacement_um"), COLUMNS.index("measured") + 1)
"""Those that the device fills."""


class Head(IntEnum):
    """Numbers at the head of each block, int64 each."""

    SEQUENCE = 0
    FIRST_SAMPLE = 1
    SAMPLES = 2
    DROPPED_BEFORE = 3
    DEADLINE_NS = 4
    LATE_NS = 5
    EXCHANGE_NS = 6


@dataclass(frozen=True, slots=True)
class Batch:
    """k blocks with B samples each.

    Attributes:
        heads: int64[k, len(Head)].
        states: float64[k, s]: the compensator's memory before each block, then the command
            before it.
        columns: float64[k, 6, B], see :data:`COLUMNS`.
        flags: uint32[k, B].
    """

    heads: I64
    states: F64
    columns: F64
    flags: U32

    @classmethod
    def empty(cls, blocks: int, block: int, state_size: int) -> "Batch":
        """Return room for blocks, in this process's own memory."""
        return cls(
            np.zeros((blocks, len(Head)), dtype=np.int64),
            np.zeros((blocks, state_size)),
            np.full((blocks, len(COLUMNS), block), np.nan),
            np.zeros((blocks, block), dtype=np.uint32),
        )

    def rows(self, chosen: slice | I64) -> "Batch":
        """Return a copy of some blocks."""
        return Batch(
            self.heads[chosen].copy(),
            self.states[chosen].copy(),
            self.columns[chosen].copy(),
            self.flags[chosen].copy(),
        )


class Flag(IntFlag):
    """Bits of a sample's ``flags``; those from 64 on belong to the interlocks of the loop."""

    RANGE_LIMITED = 1
    """The wanted command was outside the limits' range."""
    SLEW_LIMITED = 2
    """The wanted command asked for more slew than the limits allow."""
    INVALID = 4
    """The wanted command was not finite; the last command was held."""
    RAMP = 8
    """On the way out: the ramp to the safe value, without a reference."""
    SENSOR_INVALID = 16
    """The displacement was not finite, outside the stroke limits or at an end of the sensor."""
    UNANSWERED = 32
    """The device did not answer the exchange: the command may not have reached it."""
    AFTER_SKIPPED = 1 << 16
    """In the first block after skipped ticks: the output had been held, and has to catch up."""
