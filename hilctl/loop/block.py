"""A block of samples in its slot."""

from hilctl.base.samples import COLUMNS, BlockBatch

COMMAND = [*COLUMNS].index("command")


class Block:
    """A slot with B samples, occupied until the block is recorded.

    Args:
        head: Fields of :class:`hilctl.base.samples.BlockHeader`, int64 each.

    Attributes:
        number: Number of the block in the run; -1 in a spare slot, which is not recorded.
        due: Whether the block is recorded; False while the loop only waits for answers.
        guarded: Whether a tripped interlock ends the run: the block starts in the waveform or the
            conditioning.
        skipped: Samples skipped before the block.
        state: The compensator's state before the block, then the command before it: float64[s].
        memory: The compensator's state: float64[s - 1].
        flags: Bits of :class:`hilctl.base.samples.Flag` and the interlocks: uint32[B].
        columns: All columns of :data:`hilctl.base.samples.COLUMNS`: float64[k, B].
        reference: In the waveform's unit: float64[B].
        wanted: Command before the limiter: float64[B].
        command: Command sent to the device: float64[B].
        displacement_um: Filled by the device: float64[B].
        measured: Measured command, filled by the device if it has one: float64[B].
        input_um: The compensator's input: float64[B]; in the waveform's unit without a model.
        reading_age_s: Age of the displacement, if the sensor sends unsolicited samples: float64[B].
        reading_um: Displacement before its correction, if there is a calibration: float64[B].
        aux: Auxiliary channels of the device: float64[a].
    """

    def __init__(self, head: "memoryview[int]", area: BlockBatch, slot: int) -> None:
        self.head = head
        self.due = self.guarded = True
        self.number = self.skipped = 0
        self.state, self.flags = area.states[slot], area.flags[slot]
        self.memory = self.state[:-1]
        self.columns, self.aux = area.columns[slot], area.aux[slot]
        # In the order of COLUMNS.
        (
            self.reference,
            self.wanted,
            self.command,
            self.displacement_um,
            self.measured,
            self.input_um,
            self.reading_age_s,
            self.reading_um,
        ) = self.columns
