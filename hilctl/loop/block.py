"""One block of samples, in the slot where it is born and stays until it is recorded."""

from hilctl.base.samples import COLUMNS, BlockBatch

COMMAND = [*COLUMNS].index("command")


class Block:
    """One slot of an area, with B samples.

    Args:
        head: Numbers of :class:`hilctl.base.samples.BlockHeader`, int64 each.
        area: Room for many blocks.
        slot: Which of them it is.

    Attributes:
        number: The slot's number since the start of the run; -1 where it is a spare one, which is
            not recorded.
        due: Whether the block is to be recorded: not while the loop only waits for answers.
        guarded: Whether an interlock that trips in it ends the run: it begins with samples of the
            waveform or of the conditioning.
        skipped: Samples that were skipped just before it.
        state: The compensator's memory before the block, then the command before it: float64[s].
        memory: The first of these: float64[s - 1].
        flags: Bits of :class:`hilctl.base.samples.Flag` and the interlocks: uint32[B].
        columns: All that :data:`hilctl.base.samples.COLUMNS` name, those below too: float64[k, B].
        reference: In the waveform's unit: float64[B].
        wanted: Command before the limiter: float64[B].
        command: Command that is put out: float64[B].
        displacement_um: What the device fills: float64[B].
        measured: What the device fills where it measures its command: float64[B].
        input_um: The compensator's input: float64[B]; in the waveform's unit where there is none.
    """

    __slots__ = (
        "columns",
        "command",
        "displacement_um",
        "due",
        "flags",
        "guarded",
        "head",
        "input_um",
        "measured",
        "memory",
        "number",
        "reference",
        "skipped",
        "state",
        "wanted",
    )

    def __init__(self, head: "memoryview[int]", area: BlockBatch, slot: int) -> None:
        self.head = head
        self.due = self.guarded = True
        self.number = self.skipped = 0
        self.state, self.flags = area.states[slot], area.flags[slot]
        self.memory = self.state[:-1]
        self.columns = area.columns[slot]
        # In the order of COLUMNS.
        (
            self.reference,
            self.wanted,
            self.command,
            self.displacement_um,
            self.measured,
            self.input_um,
        ) = self.columns
