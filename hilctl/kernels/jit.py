"""The decorator of all kernels.

numba is imported at the first use of a kernel, because commands that compute nothing need not wait
for it.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial, update_wrapper
from typing import Any, TypeVar, cast

DISABLED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}
"""Whether kernels are plain Python functions."""
Function = TypeVar("Function", bound=Callable[..., object])


@cache
def _numba() -> Any:
    """Import numba, and register the type of a kernel that another kernel calls."""
    import numba
    from numba.extending import typeof_impl

    typeof_impl.register(_Kernel)(lambda kernel, _: numba.typeof(kernel.dispatcher))
    return numba


class _Kernel:
    """A function that numba compiles, or loads from its cache, at the first use."""

    def __init__(
        self, function: Callable[..., object], signatures: tuple[str, ...], **options: object
    ) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self._options = options
        self._signatures = list(signatures)
        self._dispatcher: Any = None

    @property
    def dispatcher(self) -> Any:
        """The compiled function, with the declared signatures only."""
        if self._dispatcher is None:
            self._dispatcher = self._compile()
        return self._dispatcher

    def _compile(self) -> Any:
        njit = partial(_numba().njit, error_model="numpy", **self._options)
        cached = partial(njit, cache=True)
        with suppress(Exception):
            return cached(self._signatures)(self.py_func)
        with suppress(Exception):  # a damaged cache entry can raise any exception
            cached()(self.py_func).recompile()  # discards the entry
            return cached(self._signatures)(self.py_func)
        # No writable folder, a full disk, or a mistake in the kernel.
        return njit(self._signatures)(self.py_func)

    def __call__(self, *arguments: object) -> object:
        return (self._dispatcher or self.dispatcher)(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__  # another process imports it


def kernel(
    *signatures: str, inline: bool = False, nogil: bool = False
) -> Callable[[Function], Function]:
    """Compile a function for the given signatures only, at its first use, and cache the result.

    Other argument types raise ``TypeError`` instead of compiling again during a run.
    ``error_model="numpy"`` omits the division checks. ``fastmath`` is off, so results have the same
    bits on every machine with IEEE arithmetic.

    A damaged cache entry is compiled again. If no folder for the cache is writable or the disk is
    full, the result is not cached. With ``NUMBA_DISABLE_JIT=1`` (for a debugger, or to measure
    coverage) the function is returned unchanged.

    Args:
        signatures: numba signatures, for example ``"void(float64[::1], float64[::1])"``.
        inline: Always inline it into the kernels that call it: for those called once per sample.
            Such a kernel must not use an array inside ``if`` or leave a loop by ``break``: numba
            then counts references to its arrays at every call, which takes longer than the work.
        nogil: Release the interpreter lock during a call: for long work beside other threads. No
            other thread may change its arrays meanwhile.

    Returns:
        A decorator that keeps the function's Python type.
    """

    def decorate(function: Function) -> Function:
        if DISABLED:
            return function
        made = _Kernel(function, signatures, forceinline=inline, nogil=nogil)
        return cast("Function", made)

    return decorate


def compiled(function: Function) -> Function:
    """Return the compiled function of a kernel: a call of it has no Python frame in between.

    Compiles it now, or loads it from the cache. Any other function is returned unchanged.
    """
    return function.dispatcher if isinstance(function, _Kernel) else function


def ensure_compiled(*kernels: object) -> None:
    """Compile kernels now, or load them from the cache, so that their first call does not wait.

    Objects that are no kernels are ignored.
    """
    for each in kernels:
        if isinstance(each, _Kernel):
            compiled(each)
