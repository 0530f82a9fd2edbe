"""Array types named once, so that signatures say what they hold."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

F64: TypeAlias = npt.NDArray[np.float64]
"""A float64 array; the docstring beside it gives the shape and the unit."""

U32: TypeAlias = npt.NDArray[np.uint32]
"""A uint32 array, used for sample flags."""

C128: TypeAlias = npt.NDArray[np.complex128]
"""A complex128 array, used for frequency responses."""

I64: TypeAlias = npt.NDArray[np.int64]
"""An int64 array, used for indices and nanoseconds."""

U8: TypeAlias = npt.NDArray[np.uint8]
"""A uint8 array, used for bytes."""
