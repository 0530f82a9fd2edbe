"""Types of arrays and of the unit of commands, for signatures."""

from collections.abc import Iterator
from typing import Annotated, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

F64: TypeAlias = npt.NDArray[np.float64]
"""A float64 array; docstrings give its shape and unit. In kernels it has one dimension."""

F64_2D: TypeAlias = Annotated[F64, "float64[:, ::1]"]
F64_3D: TypeAlias = Annotated[F64, "float64[:, :, ::1]"]
"""Arrays of kernels with numba's type: two and three dimensions, contiguous."""

U32: TypeAlias = npt.NDArray[np.uint32]
"""A uint32 array, used for sample flags."""

C128: TypeAlias = npt.NDArray[np.complex128]
"""A complex128 array, used for frequency responses."""

I64: TypeAlias = npt.NDArray[np.int64]
"""An int64 array, used for indices and nanoseconds."""

Mask: TypeAlias = npt.NDArray[np.bool_]
"""A bool array, used to choose samples or rows."""

U8: TypeAlias = npt.NDArray[np.uint8]
"""A uint8 array, used for bytes."""

CommandUnit: TypeAlias = Literal["A", "V"]
"""Coil current in ampere, or drive voltage in volt."""

CHUNK = 1_000_000
"""Values that are processed together, so that temporary arrays stay small."""


def chunks(values: F64, parts: tuple[slice, ...] | None = None) -> Iterator[F64]:
    """Yield values in pieces of :data:`CHUNK` at most: all of them, or those of some parts."""
    for part in parts or (slice(0, values.size),):
        for start in range(part.start, part.stop, CHUNK):
            yield values[start : min(start + CHUNK, part.stop)]
