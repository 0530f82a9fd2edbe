"""Blocks that have been sent and wait for their displacements, in memory claimed beforehand.

A device that plays blocks from a FIFO gives a block's displacements some exchanges later; one that
does not gives them in the same exchange, and then there is one block here, over and over.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hilctl.arrays import F64, U32


@dataclass(slots=True)
class SentBlock:
    """One block, from its commands to its displacements.

    Attributes:
        columns: float64[5, B], see :class:`hilctl.ring.Batch`; its rows are the arrays below.
        flags: uint32[B].
        state: float64[s], the memory before the block.
        first_sample: Its first sample.
        skipped: Samples skipped just before it.
        times_ns: Deadline, lateness and exchange of the tick that sent it.
        ramping: Whether all of it is on the way out.
    """

    columns: F64
    flags: U32
    state: F64
    first_sample: int = 0
    skipped: int = 0
    times_ns: tuple[int, int, int] = (0, 0, 0)
    ramping: bool = False
    reference: F64 = field(init=False)
    wanted: F64 = field(init=False)
    command: F64 = field(init=False)
    displacement_um: F64 = field(init=False)
    measured: F64 = field(init=False)

    def __post_init__(self) -> None:
        self.reference, self.wanted, self.command = self.columns[:3]
        self.displacement_um, self.measured = self.columns[3:]


class DelayLine:
    """The blocks between the exchange that sends them and the one that answers them.

    Args:
        latency_blocks: Exchanges from one to the other; 0 where they are the same.
        block: Samples in a block.
        state_size: Numbers of state kept with a block.
    """

    def __init__(self, latency_blocks: int, block: int, state_size: int) -> None:
        self._blocks = [
            SentBlock(
                np.full((5, block), np.nan), np.zeros(block, dtype=np.uint32), np.zeros(state_size)
            )
            for _ in range(latency_blocks + 1)
        ]
        self._latency_blocks = latency_blocks
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

    def exchanged(self, *, recorded: bool) -> None:
        """Move on after an exchange.

        Args:
            recorded: Whether the block just sent is to be recorded.
        """
        if not self.filling:
            self._answered += 1
        self._exchanges += 1
        self._sent += recorded

    def unanswered(self) -> Iterator[SentBlock]:
        """Return the blocks to be recorded that have no answer, oldest first."""
        for index in range(self._answered, self._sent):
            yield self._blocks[index % len(self._blocks)]
