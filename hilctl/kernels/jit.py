"""The one decorator of all kernels."""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import TypeVar, cast

import numba

from hilctl.base.private import private_folder, user_folders

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(*signatures: str, inline: bool = False) -> Callable[[Function], Function]:
    """Compile a function for the given signatures only, and keep the result on disk.

    Explicit signatures refuse any other type at once instead of compiling anew in the middle of a
    run; ``error_model="numpy"`` drops the division checks; ``fastmath`` stays off, so that results
    have the same bits wherever IEEE arithmetic holds.

    Where neither the package nor the user has a folder that can be written, or the disk is full,
    the result is kept in memory for as long as the machine runs, or not at all.

    Args:
        signatures: numba signatures, for example ``"void(float64[::1], float64[::1])"``.
        inline: Always merge it into the kernels that call it: for those called once a sample.
            Such a kernel must not use an array inside ``if`` or leave a loop by ``break``; numba
            then counts references to its arrays at every call, which takes longer than the work.

    Returns:
        A decorator that keeps the function's Python type.
    """

    def decorate(function: Function) -> Function:
        def compiled(*, kept: bool) -> Function:
            decorator = numba.njit(
                list(signatures), cache=kept, error_model="numpy", forceinline=inline
            )
            return cast("Function", decorator(function))

        # numba raises RuntimeError where it finds no folder, OSError where it can't fill it.
        with suppress(RuntimeError, OSError):
            return compiled(kept=True)
        with suppress(RuntimeError, OSError):
            if _cache_in_memory():
                return compiled(kept=True)
        return compiled(kept=False)

    return decorate


@cache
def _cache_in_memory() -> bool:
    """Have numba keep results in this user's folder in memory; False where there is none."""
    for place in user_folders():
        with suppress(OSError):
            folder = private_folder(private_folder(place) / "kernels")
            os.environ["NUMBA_CACHE_DIR"] = str(folder)  # the loop's process takes it from there
            numba.config.reload_config()
            return True
    return False
