"""Messages of numbers only, many at a time, each as the protobuf library writes it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.types import F64, I64, U32

Cells: TypeAlias = npt.NDArray[np.uint8]
Kept: TypeAlias = npt.NDArray[np.bool_]

SCOPE_T_REL = 2
"""The field of a ``Sample`` that has its time, in s."""
_SAMPLE, _FLAGS = 1, 7
_VARINT, _EIGHT_BYTES = 0, 1
_SEVEN_BITS = 0x7F
_DOUBLE = np.dtype([("tag", "u1"), ("value", "<f8")])


@dataclass(frozen=True, slots=True)
class MessageRows:
    """Messages, one a row.

    Attributes:
        cells: uint8[n, w], their bytes, with gaps.
        kept: bool[n, w], which cells are bytes of a message; None where all are, as mostly.
    """

    cells: Cells
    kept: Kept | None

    def sizes(self) -> I64:
        """Return the bytes of each message: int64[n]."""
        if self.kept is None:
            return np.full(self.cells.shape[0], self.cells.shape[1])
        found: I64 = self.kept.sum(axis=1, dtype=np.int64)
        return found

    def behind(self, heads: Cells) -> bytes:
        """Return all messages, one behind the other, each behind its head: uint8[n, h]."""
        cells = np.concatenate((heads, self.cells), axis=1)
        if self.kept is not None:
            whole = np.ones(heads.shape, dtype=np.bool_)
            cells = cells[np.concatenate((whole, self.kept), axis=1)]
        found: bytes = cells.tobytes()
        return found

    def split(self) -> Iterator[bytes]:
        """Yield each message by itself."""
        if self.kept is None:
            yield from map(np.ndarray.tobytes, self.cells)
        else:
            for cells, kept in zip(self.cells, self.kept, strict=True):
                yield cells[kept].tobytes()


def scope_rows(samples: I64, flags: U32, doubles: Mapping[int, F64]) -> MessageRows:
    """Return a ``Sample`` message of each sample.

    Args:
        samples: int64[n], their indexes.
        flags: uint32[n].
        doubles: Other numbers by field below 16, float64[n] each, in any order.
    """
    numbers = sorted(doubles)
    tagged = np.empty((samples.size, len(numbers)), dtype=_DOUBLE)
    tagged["tag"] = _tags(*numbers)
    tagged["value"] = np.array([doubles[field] for field in numbers]).T
    cells, index = tagged.view(np.uint8), _varint_cells(_SAMPLE, samples)
    there = tagged["value"].view(np.int64) != 0  # a zero is left out, as it is the default
    if not flags.any() and there.all() and index[1].all():
        return MessageRows(np.concatenate((index[0], cells), axis=1), None)
    kept = there.repeat(_DOUBLE.itemsize, axis=1)
    before = _DOUBLE.itemsize * sum(field < _FLAGS for field in numbers)
    parts = (
        index,
        (cells[:, :before], kept[:, :before]),
        _varint_cells(_FLAGS, flags.astype(np.int64)),
        (cells[:, before:], kept[:, before:]),
    )
    return MessageRows(
        np.concatenate([part for part, _ in parts], axis=1),
        np.concatenate([part for _, part in parts], axis=1),
    )


@lru_cache
def _tags(*numbers: int) -> Cells:
    """Return what stands before each number of eight bytes."""
    return (np.array(numbers) << 3 | _EIGHT_BYTES).astype(np.uint8)


def _varint_cells(field: int, values: I64) -> tuple[Cells, Kept]:
    """Return tag and bytes of numbers of no sign: lowest first, seven bits in each."""
    width = max(1, -(-int(values.max(initial=0)).bit_length() // 7))
    left = values[:, np.newaxis] >> _shifts(width)
    cells, kept = (left & _SEVEN_BITS).astype(np.uint8), left > 0
    cells[:, 1:-1] |= kept[:, 2:].view(np.uint8) << 7  # another one follows
    cells[:, 0] = field << 3 | _VARINT
    return cells, kept


@lru_cache
def _shifts(width: int) -> I64:
    """Return what shifts each seven bits of a number down, behind the one of the tag."""
    return np.arange(-7, 7 * width, 7).clip(0)
