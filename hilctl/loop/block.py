"""One block of samples, in the slot where it is born and stays until it is recorded."""

from hilctl.base.arrays import F64, U32
from hilctl.base.samples import COLUMNS

REFERENCE, WANTED, COMMAND, DISPLACEMENT_UM, MEASURED, INPUT_UM = map(
    [*COLUMNS].index,
    ("reference_um", "wanted", "command", "displacement_um", "measured", "input_um"),
)


class Block:
    """Views of one slot; B samples.

    Attributes:
        head: Numbers of :class:`hilctl.base.samples.Head`, int64 each.
        state: float64[s], the compensator's memory before the block, then the command before it.
        memory: float64[s - 1], the first of these.
        flags: uint32[B].
        reference: float64[B], in the waveform's unit.
        input_um: float64[B], the compensator's input; in the waveform's unit where there is none.
        wanted: float64[B], command before the limiter.
        command: float64[B], command that is put out.
        displacement_um: float64[B], filled by the device.
        measured: float64[B], filled by the device where it measures its command.
        columns: float64[k, B], all that :data:`hilctl.base.samples.COLUMNS` name, these six too.
        number: The slot's number since the start of the run; -1 where it is a spare one, which is
            not recorded.
        due: Whether the block is to be recorded: not while the loop only waits for answers.
        guarded: Whether an interlock that trips in it ends the run: it begins with samples of the
            waveform or of the conditioning.
        skipped: Samples that were skipped just before it.
    """

    def __init__(self, head: "memoryview[int]", state: F64, columns: F64, flags: U32) -> None:
        self.head, self.state, self.columns, self.flags = head, state, columns, flags
        self.memory = state[:-1]
        # One by one: to take the rows of an array apart in one go takes three times as long.
        self.reference, self.input_um = columns[REFERENCE], columns[INPUT_UM]
        self.wanted, self.command = columns[WANTED], columns[COMMAND]
        self.displacement_um, self.measured = columns[DISPLACEMENT_UM], columns[MEASURED]
        self.due = self.guarded = True
        self.number = self.skipped = 0
