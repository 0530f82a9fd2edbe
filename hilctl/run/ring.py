"""Shared memory between the loop and the recorder: a ring of sample blocks behind a control page.

One producer (the loop) and one consumer (the supervisor). The producer never waits: where the ring
is full, the block is counted as dropped and the next one that fits says how many samples are
missing before it. The ring is a file in memory, so that it outlives either process: a block's room
is given back only once the block is safe in the recording.

Each slot carries its own sequence number, written after everything else in it; the consumer takes a
slot only when the number is the one it expects. Blocks that have been sent to the device and have
no answer yet stand in an area of their own, so that a loop that dies leaves them behind as well.
"""

import mmap
import os
from pathlib import Path
from struct import Struct
from typing import Any, Self

import numpy as np

from hilctl.base.arrays import F64, U32
from hilctl.base.samples import ANSWERS, COLUMNS, Batch, Flag, Head
from hilctl.run.shared_page import SIZE as _PAGE_SIZE
from hilctl.run.shared_page import ControlPage, Field

_LINE = 64
_HEAD, _TAIL = int(Field.HEAD), int(Field.TAIL)
_HEAD_NUMBERS = len(Head)
_HEAD_BYTES = 8 * _HEAD_NUMBERS
_HEAD_BUT_SEQUENCE = Struct(f"{len(Head) - 1}q")
_MAGIC = 0x48494C43_52494E48


class SampleRing(ControlPage):
    """The ring, seen from either side.

    Args:
        path: File that holds it.
        create: Make a new file; otherwise an existing one is attached.
        slots: Number of blocks it holds, when created.
        block: Samples in a block, when created.
        state_size: Numbers of state kept with each block, when created.
        in_flight: Blocks that may wait for their answer, when created.
    """

    def __init__(
        self,
        path: Path,
        *,
        create: bool,
        slots: int = 0,
        block: int = 0,
        state_size: int = 0,
        in_flight: int = 0,
    ) -> None:
        self.path = path
        if create:
            size = _size(slots, block, state_size) + _size(in_flight, block, state_size)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            os.posix_fallocate(descriptor, 0, _PAGE_SIZE + size)
        else:
            descriptor = os.open(path, os.O_RDWR)
        memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size)
        os.close(descriptor)
        super().__init__(memory)
        if create:
            self.put(Field.SLOTS, slots)
            self.put(Field.BLOCK, block)
            self.put(Field.STATE_SIZE, state_size)
            self.put(Field.IN_FLIGHT, in_flight)
            self.put(Field.MAGIC, _MAGIC)
        elif self.get(Field.MAGIC) != _MAGIC:
            raise ValueError(f"{path}: is not a hilctl ring")
        self.slots, self.block = self.get(Field.SLOTS), self.get(Field.BLOCK)
        state_size, in_flight = self.get(Field.STATE_SIZE), self.get(Field.IN_FLIGHT)
        self._slots = self._area(_PAGE_SIZE, self.slots, state_size)
        self._heads = self._slots.heads.data.cast("B")
        self._heads_numbers = self._heads.cast("q")
        after = _PAGE_SIZE + _size(self.slots, self.block, state_size)
        self.sent = self._area(after, in_flight, state_size)
        """Blocks on their way: the sequence number is 0 where there is none."""
        self._head, self._tail = self.get(Field.HEAD), self.get(Field.TAIL)

    @classmethod
    def create(
        cls, path: Path, *, slots: int, block: int, state_size: int, in_flight: int = 1
    ) -> Self:
        """Make a new ring; its memory is claimed at once."""
        return cls(
            path,
            create=True,
            slots=slots,
            block=block,
            state_size=state_size,
            in_flight=in_flight,
        )

    @classmethod
    def attach(cls, path: Path) -> Self:
        """Attach to a ring that another process made.

        Raises:
            ValueError: It is no ring, or a damaged one.
            OSError: It can't be opened.
        """
        return cls(path, create=False)

    def _area(self, offset: int, slots: int, state_size: int) -> Batch:
        parts: list[Any] = []
        for (size, dtype), shape in zip(
            _sizes(slots, self.block, state_size),
            _shapes(slots, self.block, state_size),
            strict=True,
        ):
            count = size // np.dtype(dtype).itemsize
            parts.append(np.frombuffer(self._map, dtype, count, offset).reshape(shape))
            offset += _padded(size)
        return Batch(*parts)

    def push(
        self, head: tuple[int, int, int, int, int, int], state: F64, columns: F64, flags: U32
    ) -> bool:
        """Put one block in; never waits.

        Args:
            head: Numbers of :class:`~hilctl.base.samples.Head` after the sequence.
            state: float64[s], see :class:`~hilctl.base.samples.Batch`.
            columns: float64[6, B], see :class:`~hilctl.base.samples.Batch`.
            flags: uint32[B].

        Returns:
            False where the ring is full: then nothing was put in.
        """
        numbers, number = self.numbers, self._head
        if number - numbers[_TAIL] >= self.slots:
            return False
        slot = number % self.slots
        area = self._slots
        area.states[slot] = state
        area.columns[slot] = columns
        area.flags[slot] = flags
        at = slot * _HEAD_BYTES
        _HEAD_BUT_SEQUENCE.pack_into(self._heads, at + 8, *head)
        self._heads_numbers[slot * _HEAD_NUMBERS] = number + 1
        self._head = number + 1
        numbers[_HEAD] = number + 1
        return True

    def pop(self) -> Batch | None:
        """Take out all blocks there are, up to the end of the ring; None where there are none.

        They keep their room until :meth:`release`.
        """
        there = min(max(self.get(Field.HEAD) - self._tail, 0), self.slots)
        if there == 0:
            return None
        first = self._tail % self.slots
        count = min(there, self.slots - first)
        batch = self._slots.rows(slice(first, first + count))
        expected = np.arange(self._tail + 1, self._tail + count + 1)
        wrong = np.flatnonzero(batch.heads[:, Head.SEQUENCE] != expected)
        if wrong.size:  # not yet visible, or damaged: what stands before it is good
            count = int(wrong[0])
            if count == 0:
                return None
            batch = batch.rows(slice(count))
        self._tail += count
        return batch

    def skip_damaged(self) -> int:
        """Pass over blocks that will never come out; for when the producer has ended.

        Returns:
            How many there were.
        """
        there = min(max(self.get(Field.HEAD) - self._tail, 0), self.slots)
        passed = 0
        while passed < there:
            slot = (self._tail + passed) % self.slots
            if self._slots.heads[slot, Head.SEQUENCE] == self._tail + passed + 1:
                break
            passed += 1
        self._tail += passed
        return passed

    def release(self) -> None:
        """Give the room of all that was taken back to the producer: it is safe elsewhere."""
        super().release()
        self.control[Field.TAIL] = self._tail

    def unanswered(self, next_sample: int) -> Batch | None:
        """Return the blocks that were sent and never answered; for when the producer has died.

        Args:
            next_sample: Index after the last sample that came out of the ring; what was sent
                before it has come out.

        Returns:
            The blocks in order, every sample with :attr:`~hilctl.base.samples.Flag.UNANSWERED`, or
            None. The last may not have reached the device.
        """
        numbers = self.sent.heads[:, Head.SEQUENCE]
        order = np.argsort(numbers, kind="stable")
        firsts = self.sent.heads[order, Head.FIRST_SAMPLE]
        batch = self.sent.rows(order[(numbers[order] > 0) & (firsts >= next_sample)])
        if not batch.heads.shape[0]:
            return None
        batch.columns[:, ANSWERS] = np.nan
        batch.flags[:] |= np.uint32((Flag.SENSOR_INVALID | Flag.UNANSWERED).value)
        ends = [next_sample, *(batch.heads[:-1, Head.FIRST_SAMPLE] + self.block).tolist()]
        batch.heads[:, Head.DROPPED_BEFORE] = batch.heads[:, Head.FIRST_SAMPLE] - ends
        return batch


def memory_folder() -> Path:
    """Return a folder whose files live in memory, or the folder for temporary files."""
    shared = Path("/dev/shm")  # noqa: S108  the kernel's own shared-memory mount
    if shared.is_dir() and os.access(shared, os.W_OK):
        return shared
    import tempfile

    return Path(tempfile.gettempdir())


def _shapes(slots: int, block: int, state_size: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of heads, states, columns and flags."""
    width = len(COLUMNS)
    return (slots, len(Head)), (slots, state_size), (slots, width, block), (slots, block)


def _sizes(slots: int, block: int, state_size: int) -> list[tuple[int, Any]]:
    """Return bytes and types of heads, states, columns and flags."""
    types = (np.int64, np.float64, np.float64, np.uint32)
    shapes = _shapes(slots, block, state_size)
    return [
        (int(np.prod(shape)) * np.dtype(dtype).itemsize, dtype)
        for shape, dtype in zip(shapes, types, strict=True)
    ]


def _padded(size: int) -> int:
    return -(-size // _LINE) * _LINE


def _size(slots: int, block: int, state_size: int) -> int:
    return sum(_padded(size) for size, _ in _sizes(slots, block, state_size))
