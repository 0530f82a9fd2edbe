"""A ring of sample blocks in shared memory, between loop (producer) and recorder (consumer).

A block stays in its slot. The loop fills it, advances the cursor ``SENT`` and sends it to the
device; when the displacements have arrived, it advances ``HEAD``. The recorder advances ``TAIL``
only after the recording contains the block. The ring is a file in memory, so a loop or supervisor
that dies leaves all blocks, including those sent and not answered.

The producer never waits. If the ring is full, a block uses a spare slot and is counted as dropped;
the next block contains the number of samples missing before it.

Each slot has a sequence number: negative while the block is under way; positive, and written last,
when it is complete. The consumer accepts only the number that it expects. Cursors have release and
acquire order, see :mod:`hilctl.kernels.atomics`.
"""

import math
import mmap
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from hilctl.base.samples import (
    COLUMNS,
    LAST_SAMPLE,
    LONGEST_NS,
    BlockBatch,
    BlockHeader,
    Flag,
)
from hilctl.base.types import I64
from hilctl.loop.block import COMMAND, Block
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared.shared_page import SIZE as _PAGE_SIZE
from hilctl.run.shared.shared_page import PageField, SafeActionResult, SharedPage

_LINE = 64
# Plain integers: access to an enumeration's member takes longer than the write.
_SENT, _HEAD, _TAIL = int(PageField.SENT), int(PageField.HEAD), int(PageField.TAIL)
_ENDED_AT, _EXCHANGING = int(PageField.ENDED_AT), int(PageField.EXCHANGING)
_DROPPED, _UNANSWERED = int(PageField.DROPPED), int(PageField.UNANSWERED)
_SEQUENCE, _FIRST_SAMPLE = int(BlockHeader.SEQUENCE), int(BlockHeader.FIRST_SAMPLE)
_HEAD_NUMBERS = len(BlockHeader)
_MAGIC = 0x48494C43_52494E48
_MOST_BLOCKS = 50_000
"""Most block objects that are created before the first tick; each takes 1.3 kB."""
_BATCH_SAMPLES = 8192
"""Approximate samples per batch; their processing takes ten times their memory."""
_TYPES = (np.int64, np.float64, np.float64, np.uint32, np.float64)


class SampleRing:
    """The ring, for producer, consumer and watchers; these ``look_only``.

    ``at_once`` maps all pages now, for the loop, whose memory may not be locked. Raise ValueError
    if the file is not a ring or is damaged, OSError if it cannot be opened.
    """

    def __init__(self, path: Path, *, look_only: bool = False, at_once: bool = False) -> None:
        self.path = path
        descriptor = os.open(path, os.O_RDONLY if look_only else os.O_RDWR)
        try:
            prot = mmap.PROT_READ if look_only else mmap.PROT_READ | mmap.PROT_WRITE
            flags = mmap.MAP_SHARED | (mmap.MAP_POPULATE if at_once else 0)
            size = os.fstat(descriptor).st_size
            self._map = mmap.mmap(descriptor, size, flags=flags, prot=prot)
        finally:
            os.close(descriptor)
        if len(self._map) < _PAGE_SIZE:
            raise ValueError(f"{path}: is not a hilctl ring")
        self.page = SharedPage(self._map)
        if self.page.get(PageField.MAGIC) != _MAGIC:
            raise ValueError(f"{path}: is not a hilctl ring")
        self._numbers, self._integers = self.page.numbers, self.page.integers
        self._publish, self._observe = self.page.publishes, self.page.observes
        self.slots, self.block = self.page.get(PageField.SLOTS), self.page.get(PageField.BLOCK)
        self._spare = self.page.get(PageField.SPARE)
        state_size, aux = self.page.get(PageField.STATE_SIZE), self.page.get(PageField.AUX)
        if min(self.slots, self.block, self._spare, state_size, aux + 1) < 1:
            raise ValueError(f"{path}: is damaged")
        self._area = self._views(state_size, aux)
        self._heads = memoryview(self._area.heads.data.cast("B")).cast("q")
        self._spares_used = 0
        self._blocks: list[Block] = []
        self._tail = self._released = self.page.get(PageField.TAIL)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        slots: int,
        block: int,
        state_size: int,
        latency_blocks: int = 0,
        aux: int = 0,
    ) -> Self:
        """Create a ring and allocate its memory; raise OSError if there is none."""
        spare = latency_blocks + 1  # blocks that may be under way in spare slots
        _, size = _layout(slots + spare, block, state_size, aux)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            # Allocated now: missing memory must fail here, not during the run.
            os.posix_fallocate(descriptor, 0, size)
            with mmap.mmap(descriptor, _PAGE_SIZE) as memory:
                numbers = memoryview(memory).cast("q")
                numbers[PageField.SLOTS], numbers[PageField.BLOCK] = slots, block
                numbers[PageField.STATE_SIZE], numbers[PageField.SPARE] = state_size, spare
                numbers[PageField.AUX] = aux
                # Last: an incomplete ring is not valid.
                numbers[PageField.MAGIC] = _MAGIC
                numbers.release()
        finally:
            os.close(descriptor)
        made = cls(path)
        made._clean(slice(None))
        return made

    def _views(self, state_size: int, aux: int) -> BlockBatch:
        layout, size = _layout(self.slots + self._spare, self.block, state_size, aux)
        if size > len(self._map):
            raise ValueError(f"{self.path}: is shorter than it says")
        arrays: list[Any] = [
            np.frombuffer(self._map, dtype, math.prod(shape), offset).reshape(shape)
            for dtype, shape, offset in layout
        ]
        return BlockBatch(*arrays)

    def prepare_blocks(self) -> None:
        """Create the block objects of the producer before the first tick."""
        count = min(self.slots + self._spare, _MOST_BLOCKS)
        self._blocks = [self._block(slot) for slot in range(count)]

    def _block(self, slot: int) -> Block:
        at = slot * _HEAD_NUMBERS
        return Block(self._heads[at : at + _HEAD_NUMBERS], self._area, slot)

    def claim(self, *, due: bool = True) -> Block:
        """Return the next block, the same one until :meth:`sending`."""
        number = self._numbers[_SENT]
        if due and number - self._observe(self._integers, _TAIL) < self.slots:
            slot = number % self.slots
        else:
            slot, number = self.slots + self._spares_used % self._spare, -1
            self._spares_used += 1
            self._clean(slice(slot, slot + 1))
        block = self._blocks[slot] if slot < len(self._blocks) else self._block(slot)
        block.number, block.due = number, due
        return block

    def last_command(self) -> float | None:
        """Return the device's last command, or None if its block was in a spare slot."""
        sent, head = self.page.get(PageField.SENT), self.page.get(PageField.HEAD)
        ended_at = self.page.get(PageField.ENDED_AT)
        if ended_at == 0:
            return self.page.get_float(PageField.OUTPUT_AT_START)
        # The loop died before the exchange of this axis, in that of an earlier one.
        sent -= self._end_of(sent - 1) > ended_at
        # With a FIFO it is the end of the first unanswered block.
        number = min(head, sent - 1)
        if number < 0 or (number == sent - 1 and self._end_of(number) != ended_at):
            return None
        return float(self._area.columns[number % self.slots, COMMAND, -1])

    def _end_of(self, number: int) -> int:
        """Return the index after the last sample of a block."""
        return int(self._area.heads[number % self.slots, BlockHeader.FIRST_SAMPLE]) + self.block

    def sending(self, block: Block) -> None:
        """Note that a block is about to be sent."""
        if block.number >= 0:
            block.head[_SEQUENCE] = -block.number - 1
            self._publish(self._integers, _SENT, block.number + 1)
        # Last: from now on the loop may be silent while it waits for the device.
        self._numbers[_EXCHANGING] = 1

    def exchanging(self, block: Block) -> None:
        """Note that the exchange of a block begins, which follows those of other axes."""
        numbers = self._numbers
        if block.due:
            numbers[_ENDED_AT] = block.head[_FIRST_SAMPLE] + self.block
        numbers[_UNANSWERED] = 1

    def answered(self, block: Block) -> bool:
        """Hand a block to the consumer; return False if it is in a spare slot."""
        self._numbers[_EXCHANGING] = 0
        if block.number < 0:
            self._numbers[_DROPPED] += self.block
            return False
        block.head[_SEQUENCE] = block.number + 1
        self._publish(self._integers, _HEAD, block.number + 1)
        return True

    def batches(self) -> Iterator[BlockBatch]:
        """Yield the present blocks in batches; see :meth:`pop`."""
        # Not those that arrive meanwhile: on a busy computer it would not end.
        until = self._tail + self._waiting()
        while (left := until - self._tail) > 0 and (batch := self.pop(left)) is not None:
            yield batch

    def pop(self, most: int | None = None) -> BlockBatch | None:
        """Return the next blocks, at most ``most``, or None; they stay until :meth:`release`."""
        if (there := self._waiting()) == 0:
            return None
        first = self._tail % self.slots
        few = max(1, _BATCH_SAMPLES // self._area.columns.shape[2])
        count = min(there, self.slots - first, few, there if most is None else most)
        batch = self._area.rows(slice(first, first + count))
        wrong = np.flatnonzero(~_whole(batch.heads, self._tail))
        if wrong.size:  # damaged: the blocks before it are valid
            count = int(wrong[0])
            if count == 0:
                return None
            batch = batch.rows(slice(count))
        self._tail += count
        return batch

    def _waiting(self) -> int:
        """Return the number of answered blocks that were not consumed."""
        return min(max(self.page.observe(PageField.HEAD) - self._tail, 0), self.slots)

    def skip_damaged(self) -> int:
        """Skip damaged blocks after the producer has ended; return their number."""
        there, passed = self._waiting(), 0
        while passed < there:
            slot = (self._tail + passed) % self.slots
            if _whole(self._area.heads[slot : slot + 1], self._tail + passed).all():
                break
            passed += 1
        self._tail += passed
        return passed

    def look(self, since: int) -> tuple[BlockBatch, int]:
        """Copy the complete blocks from number ``since`` on without consuming them."""
        head = self.page.observe(PageField.HEAD)
        numbers = _numbers(
            max(since, self.page.observe(PageField.CLEANED), head - self.slots), head
        )
        batch = self._area.rows(numbers % self.slots)
        # Checked after the copy: blocks may have been released and cleaned meanwhile.
        whole = numbers >= self.page.observe(PageField.CLEANED)
        whole &= batch.heads[:, BlockHeader.SEQUENCE] == numbers + 1
        return batch if whole.all() else batch.rows(np.flatnonzero(whole)), max(head, since)

    def release(self, keep: int = 0) -> None:
        """Release consumed blocks to the producer, except the ``keep`` newest; they are on disk."""
        self.page.release_events()
        until = max(self._released, self._tail - keep)
        # First: watchers must not use a block that is cleaned during their copy.
        self.page.publish(PageField.CLEANED, until)
        # Cleaned here, not in the tick, and before the loop may reuse the slots.
        first, count = self._released % self.slots, until - self._released
        self._clean(slice(first, min(first + count, self.slots)))
        self._clean(slice(0, max(0, first + count - self.slots)))
        self._released = until
        self.page.publish(PageField.TAIL, until)

    def _clean(self, slots: slice) -> None:
        """Reset flags and answers of slots."""
        self._area.flags[slots] = 0
        self._area.clear_answers(slots)

    def unanswered(self, next_sample: int) -> BlockBatch | None:
        """Return the blocks that a dead producer sent without an answer, or None."""
        # They are flagged as unanswered; the last one may not have reached the device.
        sent = self.page.observe(PageField.SENT)
        numbers = _numbers(max(self.page.observe(PageField.HEAD), sent - self.slots), sent)
        slots: I64 = numbers % self.slots
        heads = self._area.heads[slots]
        under_way = heads[:, BlockHeader.SEQUENCE] == -numbers - 1
        batch = self._area.rows(
            slots[under_way & (heads[:, BlockHeader.FIRST_SAMPLE] >= next_sample)]
        )
        if not batch.heads.shape[0]:
            return None
        batch.clear_answers(slice(None))
        batch.flags[:] |= np.uint32((Flag.SENSOR_INVALID | Flag.UNANSWERED).value)
        ends = [next_sample, *(batch.heads[:-1, BlockHeader.FIRST_SAMPLE] + self.block).tolist()]
        batch.heads[:, BlockHeader.DROPPED_BEFORE] = batch.heads[:, BlockHeader.FIRST_SAMPLE] - ends
        return batch


def _numbers(first: int, stop: int) -> I64:
    """Return the numbers from ``first`` to ``stop``; none if a damaged cursor is out of range."""
    return np.arange(max(first, 0), stop) if first < stop and stop > 0 else np.empty(0, np.int64)


def _whole(heads: I64, number: int) -> npt.NDArray[np.bool_]:
    """Return which blocks have the numbers from ``number`` on and valid headers."""
    expected = np.arange(number + 1, number + 1 + heads.shape[0])
    first = heads[:, BlockHeader.FIRST_SAMPLE]
    dropped = heads[:, BlockHeader.DROPPED_BEFORE]
    possible = (first < LAST_SAMPLE) & (dropped >= 0) & (dropped <= first)
    furthest = (heads >= -LONGEST_NS) & (heads <= LONGEST_NS)
    whole: npt.NDArray[np.bool_] = (heads[:, BlockHeader.SEQUENCE] == expected) & possible
    return whole & furthest.all(axis=1)


def _layout(
    slots: int, block: int, state_size: int, aux: int
) -> tuple[list[tuple[Any, tuple[int, ...], int]], int]:
    """Return type, shape and offset of the arrays of a BlockBatch, and the file's size."""
    found, end = [], _PAGE_SIZE
    rows = (len(BlockHeader),), (state_size,), (len(COLUMNS), block), (block,), (aux,)
    shapes = [(slots, *row) for row in rows]
    for dtype, shape in zip(_TYPES, shapes, strict=True):
        found.append((dtype, shape, end))
        size = math.prod(shape) * np.dtype(dtype).itemsize
        end += -(-size // _LINE) * _LINE  # the next array begins on a cache line
    return found, end


def safe_result_of(run: RunFolder) -> SafeActionResult | None:
    """Return the result so far of the guardian of a run without supervisor, or None."""
    if run.supervised or not run.alive:
        return None
    try:
        return SampleRing(run.ring, look_only=True).page.safe_result()
    except (OSError, ValueError):  # being removed
        return None
