"""The one decorator of all kernels."""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from hilctl.base.private import private_folder, user_folders

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(*signatures: str, inline: bool = False) -> Callable[[Function], Function]:
    """Compile a function for the given signatures only, and keep the result on disk.

    That happens at its first call, or by :func:`load`: a process reads only what it needs of all
    kernels, which would take it half of its start. Explicit signatures refuse any other type at
    once instead of compiling anew in the middle of a run; ``error_model="numpy"`` drops the
    division checks; ``fastmath`` stays off, so that results have the same bits wherever IEEE
    arithmetic holds.

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
        return cast("Function", _Kernel(function, signatures, inline=inline))

    return decorate


def load(*kernels: Callable[..., object]) -> None:
    """Compile kernels now, or read them from the disk, where their first call must not wait.

    Raises:
        numba.TypingError: A kernel is not what its signatures say.
    """
    for each in kernels:
        cast("_Kernel", each).load()


def is_kernel(value: object) -> bool:
    """Return whether it is what :func:`kernel` makes."""
    return isinstance(value, _Kernel)


class _Kernel(CPUDispatcher):
    """A compiled function that has its declared signatures, from its first use on."""

    def __init__(
        self, function: Callable[..., object], signatures: tuple[str, ...], *, inline: bool
    ) -> None:
        options = {"nopython": True, "error_model": "numpy", "forceinline": inline}
        super().__init__(function, targetoptions=options)
        self._declared = signatures
        self._loaded = False

    def load(self) -> None:
        with global_compiler_lock:
            if not self._loaded:
                self._compile_declared()
                self.disable_compile()
                self._loaded = True

    # numba asks these two for types that it has nothing compiled for, from Python and from another
    # kernel. Once compiling is disabled, it refuses such types by itself.

    def _compile_for_args(self, *_args: object, **_named: object) -> "_Kernel":
        self.load()
        return self  # numba calls what it gets here

    def get_call_template(self, args: Any, kws: Any) -> Any:
        self.load()
        return super().get_call_template(args, kws)

    def _compile_declared(self) -> None:
        # numba raises RuntimeError where it finds no folder, OSError where it can't fill it.
        with suppress(RuntimeError, OSError):
            self._compile_kept()
            return
        with suppress(RuntimeError, OSError):
            if _cache_in_memory():
                self._compile_kept()
                return
        self._cache = NullCache()
        self._compile_all()

    def _compile_kept(self) -> None:
        self.enable_caching()
        done: Any
        for done in self.overloads.values():  # what the folder before had no room for
            self._cache.save_overload(done.signature, done)
        self._compile_all()

    def _compile_all(self) -> None:
        for signature in self._declared:
            self.compile(signature)


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
