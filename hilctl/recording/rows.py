"""Messages of numbers only, many at a time, each as the protobuf library writes it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from hilctl.base.arrays import F64, I64, U32

Cells: TypeAlias = npt.NDArray[np.uint8]
Kept: TypeAlias = npt.NDArray[np.bool_]
_Element = TypeVar("_Element", np.uint8, np.bool_)

SCOPE_T_REL = 2
"""The field of a ``Sample`` that has its time, in s."""
_SAMPLE, _FLAGS = 1, 7
_VARINT, _EIGHT_BYTES = 0, 1
_SEVEN_BITS = 0x7F


@dataclass(frozen=True, slots=True)
class MessageRows:
    """Messages, one a row.

    Attributes:
        cells: uint8[n, w], their bytes, with gaps.
        kept: bool[n, w], which cells are bytes of a message.
    """

    cells: Cells
    kept: Kept

    def sizes(self) -> I64:
        """Return the bytes of each message: int64[n]."""
        found: I64 = self.kept.sum(axis=1, dtype=np.int64)
        return found

    def behind(self, heads: Cells) -> bytes:
        """Return all messages, one behind the other, each behind its head: uint8[n, h]."""
        whole = np.ones(heads.shape, dtype=np.bool_)
        cells = np.concatenate((heads, self.cells), axis=1)
        found: bytes = cells[np.concatenate((whole, self.kept), axis=1)].tobytes()
        return found

    def split(self) -> Iterator[bytes]:
        """Yield each message by itself."""
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
    before = sum(field < _FLAGS for field in numbers)
    cells = np.empty((samples.size, len(numbers), 9), dtype=np.uint8)
    kept = np.empty(cells.shape, dtype=np.bool_)
    bits = np.array([doubles[field] for field in numbers]).T.copy().view(np.int64)
    cells[:, :, 0] = np.array(numbers) << 3 | _EIGHT_BYTES
    cells[:, :, 1:] = bits.view(np.uint8).reshape(*bits.shape, 8)
    kept[:] = bits[:, :, np.newaxis] != 0  # a zero is left out, as it is the default
    parts = [
        _varint_cells(_SAMPLE, samples),
        (_flat(cells[:, :before]), _flat(kept[:, :before])),
        (_flat(cells[:, before:]), _flat(kept[:, before:])),
    ]
    if flags.any():
        parts.insert(2, _varint_cells(_FLAGS, flags.astype(np.int64)))
    return MessageRows(
        np.concatenate([part for part, _ in parts], axis=1),
        np.concatenate([part for _, part in parts], axis=1),
    )


def _flat(cells: npt.NDArray[_Element]) -> npt.NDArray[_Element]:
    return cells.reshape(cells.shape[0], cells.shape[1] * cells.shape[2])


def _varint_cells(field: int, values: I64) -> tuple[Cells, Kept]:
    """Return tag and bytes of numbers of no sign: lowest first, seven bits in each."""
    width = max(1, -(-int(values.max(initial=0)).bit_length() // 7))
    left = values[:, np.newaxis] >> np.arange(-7, 7 * width, 7).clip(0)
    cells = (left & _SEVEN_BITS).astype(np.uint8)
    cells[:, 1:-1] |= (left[:, 2:] > 0).view(np.uint8) << 7  # another one follows
    cells[:, 0] = field << 3 | _VARINT
    return cells, left > 0
