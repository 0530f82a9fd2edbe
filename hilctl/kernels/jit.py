"""The one decorator of all kernels."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(*signatures: str, inline: bool = False) -> Callable[[Function], Function]:
    """Compile a function for the given signatures only, and keep the result on disk.

    Explicit signatures refuse any other type at once instead of compiling anew in the middle of a
    run; ``error_model="numpy"`` drops the division checks; ``fastmath`` stays off, so that results
    have the same bits wherever IEEE arithmetic holds.

    Args:
        signatures: numba signatures, for example ``"void(float64[::1], float64[::1])"``.
        inline: Always merge it into the kernels that call it: for those called once a sample.
            Such a kernel must not use an array inside ``if`` or leave a loop by ``break``; numba
            then counts references to its arrays at every call, which takes longer than the work.

    Returns:
        A decorator that keeps the function's Python type.
    """

    def decorate(function: Function) -> Function:
        compiled = numba.njit(
            list(signatures), cache=True, error_model="numpy", forceinline=inline
        )(function)
        return cast("Function", compiled)

    return decorate
