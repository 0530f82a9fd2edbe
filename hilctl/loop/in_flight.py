"""Blocks that have been sent and wait for their displacements, in memory claimed beforehand.

A device that plays blocks from a FIFO gives a block's displacements some exchanges later; one that
does not gives them in the same exchange, and then there is one block here, over and over. The
memory is the ring's, so that what was sent outlives the loop.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from hilctl.base.arrays import F64, I64, U32
from hilctl.base.samples import Batch, Head

_SEQUENCE = int(Head.SEQUENCE)


@dataclass(slots=True)
class SentBlock:
    """One block, from its commands to its displacements.

    Attributes:
        head: int64[len(Head)], what others see of it while it is on its way.
        columns: float64[6, B], see :data:`hilctl.base.samples.COLUMNS`; its rows are below.
        flags: uint32[B].
        state: float64[s], the memory before the block.
        first_sample: Its first sample.
        skipped: Samples skipped just before it.
        times_ns: Deadline, lateness and exchange of the tick that sent it.
        following: Whether it begins with samples of the waveform.
    """

    head: I64
    columns: F64
    flags: U32
    state: F64
    first_sample: int = 0
    skipped: int = 0
    times_ns: tuple[int, int, int] = (0, 0, 0)
    following: bool = True
    reference: F64 = field(init=False)
    wanted: F64 = field(init=False)
    command: F64 = field(init=False)
    displacement_um: F64 = field(init=False)
    measured: F64 = field(init=False)
    input_um: F64 = field(init=False)
    memory: F64 = field(init=False)
    numbers: "memoryview[int]" = field(init=False)

    def __post_init__(self) -> None:
        self.reference, self.wanted, self.command = self.columns[:3]
        self.displacement_um, self.measured, self.input_um = self.columns[3:]
        self.memory = self.state[:-1]
        self.numbers = self.head.data.cast("B").cast("q")


class DelayLine:
    """The blocks between the exchange that sends them and the one that answers them.

    Args:
        storage: Room for as many blocks as exchanges from one to the other, and one more.
    """

    def __init__(self, storage: Batch) -> None:
        parts = zip(storage.heads, storage.columns, storage.flags, storage.states, strict=True)
        self._blocks = [SentBlock(*part) for part in parts]
        self._latency_blocks = len(self._blocks) - 1
        self._exchanges = 0
        self._sent = 0
        self._answered = 0

    @property
    def newest(self) -> SentBlock:
        """Where the next exchange's commands go."""
        return self._blocks[self._exchanges % len(self._blocks)]

    @property
    def oldest(self) -> SentBlock:
        """Where the next exchange's displacements go; of no meaning while :attr:`filling`."""
        return self._blocks[(self._exchanges + 1) % len(self._blocks)]

    @property
    def filling(self) -> bool:
        """Whether the next exchange comes too early to answer any block."""
        return self._exchanges < self._latency_blocks

    @property
    def waiting(self) -> bool:
        """Whether a block that is to be recorded has no answer yet."""
        return self._answered < self._sent

    def sending(self) -> None:
        """Note that the newest block is on its way and to be recorded, before it is."""
        block = self.newest
        self._sent = self._exchanges + 1
        deadline_ns, late_ns, _ = block.times_ns
        size = block.flags.size
        head = block.numbers
        head[1], head[2], head[3] = block.first_sample, size, block.skipped
        head[4], head[5], head[6] = deadline_ns, late_ns, 0
        head[_SEQUENCE] = self._sent

    def exchanged(self) -> None:
        """Move on after an exchange."""
        if not self.filling:
            self._answered += 1
        self._exchanges += 1

    def unanswered(self) -> Iterator[SentBlock]:
        """Return the blocks to be recorded that have no answer, oldest first."""
        for index in range(self._answered, self._sent):
            yield self._blocks[index % len(self._blocks)]
