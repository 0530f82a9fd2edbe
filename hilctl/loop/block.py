"""One block of samples, in the slot where it is born and stays until it is recorded."""

from functools import cached_property

from hilctl.base.arrays import F64, U32
from hilctl.base.samples import COLUMNS, Batch

REFERENCE, WANTED, COMMAND, DISPLACEMENT_UM, MEASURED, INPUT_UM = map(
    [*COLUMNS].index,
    ("reference_um", "wanted", "command", "displacement_um", "measured", "input_um"),
)


class Block:
    """One slot of an area, with B samples.

    Views of its arrays are made where they are first asked for: a tick that is composed needs none.

    Args:
        head: Numbers of :class:`hilctl.base.samples.Head`, int64 each.
        area: Room for many blocks.
        slot: Which of them it is.

    Attributes:
        number: The slot's number since the start of the run; -1 where it is a spare one, which is
            not recorded.
        due: Whether the block is to be recorded: not while the loop only waits for answers.
        guarded: Whether an interlock that trips in it ends the run: it begins with samples of the
            waveform or of the conditioning.
        skipped: Samples that were skipped just before it.
        composed: Whether its commands were worked out by the composed calls.
    """

    def __init__(self, head: "memoryview[int]", area: Batch, slot: int) -> None:
        self.head, self.area, self.slot = head, area, slot
        self.due, self.guarded, self.composed = True, True, False
        self.number = self.skipped = 0

    @cached_property
    def state(self) -> F64:
        """The compensator's memory before the block, then the command before it: float64[s]."""
        state: F64 = self.area.states[self.slot]
        return state

    @property
    def memory(self) -> F64:
        """The first of these: float64[s - 1]."""
        return self.state[:-1]

    @cached_property
    def flags(self) -> U32:
        """Bits of :class:`hilctl.base.samples.Flag` and the interlocks: uint32[B]."""
        flags: U32 = self.area.flags[self.slot]
        return flags

    @cached_property
    def columns(self) -> F64:
        """All that :data:`hilctl.base.samples.COLUMNS` name, those below too: float64[k, B]."""
        columns: F64 = self.area.columns[self.slot]
        return columns

    @cached_property
    def reference(self) -> F64:
        """In the waveform's unit: float64[B]."""
        return self._row(REFERENCE)

    @cached_property
    def input_um(self) -> F64:
        """The compensator's input: float64[B]; in the waveform's unit where there is none."""
        return self._row(INPUT_UM)

    @cached_property
    def wanted(self) -> F64:
        """Command before the limiter: float64[B]."""
        return self._row(WANTED)

    @cached_property
    def command(self) -> F64:
        """Command that is put out: float64[B]."""
        return self._row(COMMAND)

    @cached_property
    def displacement_um(self) -> F64:
        """What the device fills: float64[B]."""
        return self._row(DISPLACEMENT_UM)

    @cached_property
    def measured(self) -> F64:
        """What the device fills where it measures its command: float64[B]."""
        return self._row(MEASURED)

    def _row(self, number: int) -> F64:
        row: F64 = self.columns[number]
        return row
