"""Shared memory between the loop and the recorder: a ring of sample blocks, and a control page.

One producer (the loop) and one consumer (the supervisor). The producer never waits: where the ring
is full, the block is counted as dropped and the next one that fits says how many samples are
missing before it. The ring is a file in memory, so that it outlives either process.

Each slot carries its own sequence number, written after everything else in it; the consumer takes a
slot only when the number is the one it expects.
"""

import mmap
import os
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Self

import numpy as np

from hilctl.arrays import F64, I64, U32

_PAGE = 4096
_TEXT_BYTES = 8192
_LINE = 64
_MAGIC = 0x48494C43_52494E47
_COLUMNS = ("reference", "wanted", "command", "displacement_um", "measured")


class Field(IntEnum):
    """Numbers in the control page, int64 each."""

    MAGIC = 0
    SLOTS = 1
    BLOCK = 2
    STATE_SIZE = 3
    HEAD = 8
    TAIL = 16
    PHASE = 24
    GO = 25
    STOP = 26
    LOOP_BEAT_NS = 27
    START_NS = 29
    LATE_TICKS = 32
    SKIPPED_TICKS = 33
    WORST_LATE_NS = 34
    WORST_LATE_TICK = 35
    LONGEST_LATE_RUN = 36


class Phase(IntEnum):
    """How far the loop process has come."""

    STARTING = 0
    READY = 1
    RUNNING = 2
    ENDED = 3
    FAILED = 4


class Head(IntEnum):
    """Numbers at the head of each slot, int64 each."""

    SEQUENCE = 0
    FIRST_SAMPLE = 1
    SAMPLES = 2
    DROPPED_BEFORE = 3
    DEADLINE_NS = 4
    LATE_NS = 5
    EXCHANGE_NS = 6


@dataclass(frozen=True, slots=True)
class Batch:
    """Blocks taken out of the ring together, k of them with B samples each.

    Attributes:
        heads: int64[k, len(Head)].
        states: float64[k, s]: the compensator's memory before each block, then the command
            before it.
        columns: float64[k, 5, B]: reference, wanted, command, displacement_um, measured.
        flags: uint32[k, B].
    """

    heads: I64
    states: F64
    columns: F64
    flags: U32


class SampleRing:
    """The ring, seen from either side.

    Args:
        path: File that holds it.
        create: Make a new file; otherwise an existing one is attached.
        slots: Number of blocks it holds, when created.
        block: Samples in a block, when created.
        state_size: Numbers of state kept with each block, when created.
    """

    def __init__(
        self, path: Path, *, create: bool, slots: int = 0, block: int = 0, state_size: int = 0
    ) -> None:
        self.path = path
        if create:
            size = sum(_extents(slots, block, state_size)[-1])
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            os.posix_fallocate(descriptor, 0, size)
        else:
            descriptor = os.open(path, os.O_RDWR)
            size = os.fstat(descriptor).st_size
        self._map = mmap.mmap(descriptor, size)
        os.close(descriptor)
        self.control: I64 = np.frombuffer(self._map, dtype=np.int64, count=_PAGE // 8)
        if create:
            self.control[Field.SLOTS] = slots
            self.control[Field.BLOCK] = block
            self.control[Field.STATE_SIZE] = state_size
            self.control[Field.MAGIC] = _MAGIC
        elif self.control[Field.MAGIC] != _MAGIC:
            raise ValueError(f"{path}: is not a hilctl ring")
        self.slots = int(self.control[Field.SLOTS])
        self.block = int(self.control[Field.BLOCK])
        self._map_slots(int(self.control[Field.STATE_SIZE]))
        self._head = int(self.control[Field.HEAD])
        self._tail = int(self.control[Field.TAIL])

    @classmethod
    def create(cls, path: Path, *, slots: int, block: int, state_size: int) -> Self:
        """Make a new ring; its memory is claimed at once."""
        return cls(path, create=True, slots=slots, block=block, state_size=state_size)

    @classmethod
    def attach(cls, path: Path) -> Self:
        """Attach to a ring that another process made."""
        return cls(path, create=False)

    def _map_slots(self, state_size: int) -> None:
        numbers, floats, bits = np.dtype(np.int64), np.dtype(np.float64), np.dtype(np.uint32)
        heads, states, columns, flags = _extents(self.slots, self.block, state_size)
        width = len(_COLUMNS)
        self._heads: I64 = self._part(numbers, heads).reshape(self.slots, len(Head))
        self._states: F64 = self._part(floats, states).reshape(self.slots, state_size)
        self._columns: F64 = self._part(floats, columns).reshape(self.slots, width, self.block)
        self._flags: U32 = self._part(bits, flags).reshape(self.slots, self.block)

    def _part(self, dtype: np.dtype[Any], extent: tuple[int, int]) -> Any:
        offset, size = extent
        return np.frombuffer(self._map, dtype, count=size // dtype.itemsize, offset=offset)

    def push(
        self, head: tuple[int, int, int, int, int, int], state: F64, columns: F64, flags: U32
    ) -> bool:
        """Put one block in; never waits.

        Args:
            head: Numbers of :class:`Head` after the sequence.
            state: float64[s], see :class:`Batch`.
            columns: float64[5, B], see :class:`Batch`.
            flags: uint32[B].

        Returns:
            False where the ring is full: then nothing was put in.
        """
        control = self.control
        if self._head - control[Field.TAIL] >= self.slots:
            return False
        slot = self._head % self.slots
        self._states[slot] = state
        self._columns[slot] = columns
        self._flags[slot] = flags
        row = self._heads[slot]
        row[1:] = head
        row[Head.SEQUENCE] = self._head + 1
        self._head += 1
        control[Field.HEAD] = self._head
        return True

    def pop(self) -> Batch | None:
        """Take out all blocks there are, up to the end of the ring; None where there are none."""
        head = int(self.control[Field.HEAD])
        if head == self._tail:
            return None
        first = self._tail % self.slots
        count = min(head - self._tail, self.slots - first)
        rows = slice(first, first + count)
        heads = self._heads[rows].copy()
        expected = np.arange(self._tail + 1, self._tail + count + 1)
        wrong = np.flatnonzero(heads[:, Head.SEQUENCE] != expected)
        if wrong.size:  # not yet visible, or damaged: what stands before it is good
            count = int(wrong[0])
            if count == 0:
                return None
        rows = slice(first, first + count)
        batch = Batch(
            heads[:count],
            self._states[rows].copy(),
            self._columns[rows].copy(),
            self._flags[rows].copy(),
        )
        self._tail += count
        self.control[Field.TAIL] = self._tail
        return batch

    def get(self, field: Field) -> int:
        """Return a number of the control page."""
        return int(self.control[field])

    def put(self, field: Field, value: int) -> None:
        """Set a number of the control page."""
        self.control[field] = value

    def write_text(self, text: str) -> None:
        """Leave a text for the other side, cut to what fits."""
        raw = text.encode()[: _TEXT_BYTES - 8].decode(errors="ignore").encode()
        self._map[_PAGE + 8 : _PAGE + 8 + len(raw)] = raw
        self._map[_PAGE : _PAGE + 8] = len(raw).to_bytes(8, "little")

    def read_text(self) -> str:
        """Return the text that the other side left."""
        length = int.from_bytes(self._map[_PAGE : _PAGE + 8], "little")
        length = min(length, _TEXT_BYTES - 8)
        return bytes(self._map[_PAGE + 8 : _PAGE + 8 + length]).decode(errors="replace")

    def unlink(self) -> None:
        """Remove the file; both sides keep what they have mapped."""
        self.path.unlink(missing_ok=True)


def memory_folder() -> Path:
    """Return a folder whose files live in memory, or the folder for temporary files."""
    shared = Path("/dev/shm")  # noqa: S108  the kernel's own shared-memory mount
    if shared.is_dir() and os.access(shared, os.W_OK):
        return shared
    import tempfile

    return Path(tempfile.gettempdir())


def _extents(slots: int, block: int, state_size: int) -> list[tuple[int, int]]:
    """Return offset and size in bytes of heads, states, columns and flags."""
    sizes = (
        slots * len(Head) * 8,
        slots * state_size * 8,
        slots * len(_COLUMNS) * block * 8,
        slots * block * 4,
    )
    extents = []
    offset = _PAGE + _TEXT_BYTES
    for size in sizes:
        extents.append((offset, size))
        offset += -(-size // _LINE) * _LINE
    return extents
