"""The arithmetic of the usual tick, composed before the run: a call before the exchange, one after.

The kernels are those that the loop's other ticks call, see :mod:`hilctl.kernels.tick`; so a run has
the same bits whichever of its ticks are composed.
"""

import numpy as np

from hilctl.base.arrays import F64, I64, U32
from hilctl.base.samples import COLUMNS, Batch, Head
from hilctl.kernels import tick
from hilctl.kernels.interlock import interlock_block
from hilctl.kernels.jit import address, entry, is_kernel, load
from hilctl.kernels.limit import limit_block
from hilctl.loop import block as rows
from hilctl.loop.block import Block
from hilctl.loop.interlocks import Interlocks, Trip
from hilctl.loop.limiter import BITS, Limiter
from hilctl.loop.plan import Plan
from hilctl.models.base import Stage

_ROWS = {
    tick.REFERENCE_ROW: rows.REFERENCE,
    tick.WANTED_ROW: rows.WANTED,
    tick.COMMAND_ROW: rows.COMMAND,
    tick.DISPLACEMENT_ROW: rows.DISPLACEMENT_UM,
    tick.MEASURED_ROW: rows.MEASURED,
    tick.INPUT_ROW: rows.INPUT_UM,
}
_FIRST_SAMPLE = int(Head.FIRST_SAMPLE)


class Composed:
    """What a run's ticks work out, as two calls.

    Args:
        plan: The run's.
        stages: What its compensator runs.
        limiter: The run's, whose last command the calls keep.
        interlocks: The run's, whose memory the calls keep.

    Attributes:
        command: float64[B], of the block that was filled last, for its exchange.
        displacement_um: float64[B], for the device to fill.
        measured: float64[B], for the device to fill where it measures its command.
        table: int64[t], what is composed.
    """

    def __init__(
        self, plan: Plan, stages: list[Stage], limiter: Limiter, interlocks: Interlocks
    ) -> None:
        # What stands in the table by its address must stay where it is.
        self._kept = (plan.reference, plan.input_um, limiter, stages)
        self._interlocks = interlocks
        self._exchange = np.full((3, plan.block), np.nan)
        self.command, self.displacement_um, self.measured = self._exchange
        self._area: Batch | None = None
        self.table = self._constants(plan, stages, limiter, interlocks)
        load(tick.follow_block)
        self._plan_block, self._answer_block = entry(tick.plan_block), entry(tick.answer_block)

    def _constants(
        self, plan: Plan, stages: list[Stage], limiter: Limiter, interlocks: Interlocks
    ) -> I64:
        table = np.zeros(tick.FIRST_STAGE + tick.STAGE_NUMBERS * len(stages), dtype=np.int64)
        for place, row in _ROWS.items():
            table[place] = row
        table[tick.BLOCK], table[tick.WIDTH] = plan.block, len(COLUMNS)
        table[tick.REFERENCE] = _where(plan.reference)
        table[tick.REFERENCE_SIZE] = plan.reference.size
        table[tick.INPUT] = _where(plan.input_um)
        table[tick.EXCHANGE] = _where(self._exchange)
        table[tick.LIMIT], table[tick.LIMITS] = address(limit_block), _where(limiter.numbers)
        table[tick.RANGE_BIT], table[tick.SLEW_BIT], table[tick.INVALID_BIT] = BITS
        table[tick.INTERLOCK] = address(interlock_block)
        table[tick.SETTINGS] = _where(interlocks.numbers)
        table[tick.SETTINGS_SIZE] = interlocks.numbers.size
        table[tick.INTERLOCK_MEMORY] = _where(interlocks.memory)
        table[tick.INTERLOCK_MEMORY_SIZE] = interlocks.memory.size
        memory = plan.compensator.memory
        table[tick.MEMORY], table[tick.STATE_SIZE] = _where(memory), memory.size + 1
        table[tick.STAGES] = len(stages)
        for i, stage in enumerate(stages):
            place = tick.FIRST_STAGE + tick.STAGE_NUMBERS * i
            arrays = (stage.parameters, stage.memory)
            numbers = [number for each in arrays for number in (_where(each), each.size)]
            table[place : place + tick.STAGE_NUMBERS] = (address(stage.kernel), *numbers)
        return table

    def stands_in(self, area: Batch) -> None:
        """Take blocks of another area from now on."""
        table = self.table
        state, columns, flags = (each.shape[1:] for each in (area.states, area.columns, area.flags))
        n, width, size = table[[tick.BLOCK, tick.WIDTH, tick.STATE_SIZE]].tolist()
        if (state, columns, flags) != ((size,), (width, n), (n,)):
            raise ValueError(f"blocks of {n} samples and {size} numbers of state do not fit there")
        table[tick.STATES] = _where(area.states)
        table[tick.COLUMNS], table[tick.FLAGS] = _where(area.columns), _where(area.flags)
        self._area = area

    def plan_block(self, block: Block, start: int) -> int:
        """Fill a block that lies in the waveform as a whole, from its sample ``start`` on.

        Returns:
            Index of the first wish that is not finite, or -1.
        """
        if block.area is not self._area:
            self.stands_in(block.area)
        return self._plan_block(self.table, block.slot, start)

    def follow_block(self, block: Block) -> int:
        """Fill a block whose reference and input stand in it already; returns the same."""
        if block.area is not self._area:
            self.stands_in(block.area)
        return tick.follow_block(self.table, block.slot)

    def judge(self, block: Block) -> Trip | None:
        """Put what the exchange brought into a block, perhaps an earlier one, and judge it."""
        if block.area is not self._area:
            self.stands_in(block.area)
        first_sample = block.head[_FIRST_SAMPLE]
        before = self._interlocks.reach(first_sample, self.command.size)
        k = self._answer_block(self.table, block.slot)
        return None if k < 0 else self.trip(block, k, before)

    def trip(self, block: Block, k: int, before: float) -> Trip | None:
        """Say what tripped at the k-th sample of a block; ``before`` is the command before it."""
        commands = before, block.command, block.measured
        lengths = block.reference, block.displacement_um
        first_sample = block.head[_FIRST_SAMPLE]
        return self._interlocks.trip(first_sample, k, commands, lengths, block.flags)


def compose(plan: Plan, limiter: Limiter, interlocks: Interlocks) -> Composed | None:
    """Return the calls of a run; None where its kernels are more than stages, or not compiled."""
    stages = plan.compensator.stages()
    arrays = plan.reference, plan.input_um
    if stages is None or not is_kernel(limit_block) or not all(_plain(each) for each in arrays):
        return None
    return Composed(plan, stages, limiter, interlocks)


def _plain(values: F64) -> bool:
    return bool(values.flags.c_contiguous and values.dtype == np.float64)


def _where(values: F64 | U32) -> int:
    if not values.flags.c_contiguous:
        raise ValueError("an array that is called by its address must be contiguous")
    return values.ctypes.data
