"""Integral feedback on the means of blocks: takes out offset, creep and drift, and nothing faster.

For every device, those that play blocks from a FIFO included: it holds each block whose
displacements have come against the references that were due in it, and corrects the compensator's
input of the blocks to come. A mean over a block has little noise; and with a bandwidth well below
1 / (2 pi times the delay of the whole loop) no delay of a FIFO makes it swing.
"""

import math

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.loop.block import Block
from hilctl.loop.feedback import Polarity

_LIMITED = int(Flag.RANGE_LIMITED | Flag.SLEW_LIMITED)


class IntegralFeedback:
    """The integrator of one run; it never waits and never gives a NaN.

    Args:
        gain_per_block: um of correction per um of error and block, > 0.
        limit_um: Largest correction, > 0.
        due_after: Samples from a reference to the displacement that is to show it.
        shown_after: Blocks from a correction to the displacements that show all of it.
    """

    def __init__(
        self, gain_per_block: float, limit_um: float, due_after: int, shown_after: int
    ) -> None:
        if not 0.0 < gain_per_block < 1.0:
            raise InputError(f"gain_per_block must be > 0 and < 1: {gain_per_block}")
        if not 0.0 < limit_um < math.inf:
            raise InputError(f"limit_um must be > 0: {limit_um}")
        self._gain, self._limit_um = gain_per_block, limit_um
        self._before_due: F64 = np.full(due_after, math.nan)
        self._integral_um = 0.0
        self.correction_um = 0.0
        """Correction at the end of the newest block, in um, within the limit."""
        self._polarity = Polarity(limit_um, shown_after)

    @property
    def against(self) -> str:
        """Why sensor and command can't be of one sign; empty as long as they may be."""
        return self._polarity.against

    def follow(self, block: Block, input_um: F64) -> None:
        """Correct the input of a block's samples that follow the reference: float64[n].

        The correction moves in a line over the block: a step of it would come out of a compensator
        with a lead as a spike of the command.
        """
        before, change = self.correction_um, self._integral_um - self.correction_um
        size = block.reference.size
        if change:
            input_um += before + change / size * np.arange(1, input_um.size + 1)
        elif before:
            input_um += before
        self.correction_um = before + change * input_um.size / size

    def take(self, block: Block) -> None:
        """Judge a block whose displacements have come.

        Nothing is integrated of a block on a ramp, after skipped ticks, or in which an interlock
        has tripped or a reading is missing; where the limiter held a command back, the correction
        may only shrink.
        """
        error_um, due_um, displacement_um = self._error(block)
        flags = int(np.bitwise_or.reduce(block.flags))
        if flags & ~_LIMITED or not math.isfinite(error_um):
            return
        before = self._integral_um
        after = before + self._gain * error_um
        if flags and abs(after) > abs(before):
            return
        self._integral_um = min(self._limit_um, max(-self._limit_um, after))
        if not flags:  # a command that is held back says nothing
            self._polarity.look(self._integral_um, due_um, displacement_um)

    def _error(self, block: Block) -> tuple[float, float, float]:
        """Return the block's mean error, mean of the references due in it, mean displacement."""
        if block.skipped:
            self._before_due[:] = math.nan
        size, wait = block.reference.size, self._before_due.size
        due = block.reference
        if wait:
            both = np.concatenate((self._before_due, due))
            due, self._before_due = both[:size], both[size:]
        due_um, displacement_um = float(due.mean()), float(block.displacement_um.mean())
        return due_um - displacement_um, due_um, displacement_um
