"""The decorator of all kernels.

numba is imported at the first use of a kernel, so commands that compute nothing do not wait for it.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial, update_wrapper
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

from hilctl.base.private_dirs import private_folder, user_folders
from hilctl.base.types import F64, I64, U32

DISABLED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}
"""Whether kernels are plain Python functions."""
Function = TypeVar("Function", bound=Callable[..., object])


@cache
def _numba() -> Any:
    """Import numba, and register the type of kernels called by other kernels."""
    import numba
    from numba.extending import typeof_impl

    typeof_impl.register(_Kernel)(lambda kernel, _: numba.typeof(kernel.dispatcher))
    config: Any = numba.config
    config.CACHE_DIR = config.CACHE_DIR or _cache_folder()
    return numba


def _cache_folder() -> str:
    """Return a folder in memory if neither the package's nor the user's cache is writable."""
    user_cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    if not any(os.access(each, os.W_OK) for each in (Path(__file__).parent, user_cache)):
        for folder in user_folders():
            with suppress(OSError):
                return str(private_folder(private_folder(folder) / "kernels"))
    return ""


class _Kernel:
    """A function that numba compiles, or loads from its cache, at the first use."""

    def __init__(self, function: Callable[..., object], **options: object) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self._options = options
        self._dispatcher: Any = None

    @property
    def dispatcher(self) -> Any:
        """The compiled function, for the annotated types only."""
        if self._dispatcher is None:
            self._dispatcher = self._compile()
        return self._dispatcher

    def _compile(self) -> Any:
        njit = partial(_numba().njit, error_model="numpy", **self._options)
        signature = _signature(self.py_func)
        cached = partial(njit, cache=True)
        with suppress(Exception):
            return cached(signature)(self.py_func)
        with suppress(Exception):  # a damaged cache entry can raise any exception
            cached()(self.py_func).recompile()  # discards the entry
            return cached(signature)(self.py_func)
        # No writable folder, a full disk, or a mistake in the kernel.
        return njit(signature)(self.py_func)

    def __call__(self, *arguments: object) -> object:
        return (self._dispatcher or self.dispatcher)(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__  # another process imports it


_TYPES: dict[Any, str] = {
    type(None): "void", bool: "boolean", int: "int64", float: "float64",
    F64: "float64[::1]", I64: "int64[::1]", U32: "uint32[::1]",
}  # fmt: skip


def _signature(function: Callable[..., object]) -> str:
    """Return numba's signature of a function, from its annotations."""
    hints = get_type_hints(function, include_extras=True)
    result = _type_name(hints.pop("return"))
    return f"{result}({', '.join(map(_type_name, hints.values()))})"


def _type_name(hint: Any) -> str:
    """Return numba's name of a type; the annotation of an array has that of another shape."""
    if get_origin(hint) is Annotated:
        return str(hint.__metadata__[0])
    if get_origin(hint) is tuple:
        return f"Tuple(({', '.join(map(_type_name, get_args(hint)))},))"
    return _TYPES[hint]


def kernel(*, inline: bool = False, nogil: bool = False) -> Callable[[Function], Function]:
    """Compile a function for its annotated types only, at its first use, and cache the result.

    Other argument types raise ``TypeError`` instead of compiling again during a run.
    ``error_model="numpy"`` omits the division checks. ``fastmath`` is off, so results have the same
    bits on every machine with IEEE arithmetic.

    A damaged cache entry is compiled again. If no folder for the cache is writable or the disk is
    full, the result is not cached. With ``NUMBA_DISABLE_JIT=1`` (for a debugger, or to measure
    coverage) the function is returned unchanged.

    Args:
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
        made = _Kernel(function, forceinline=inline, nogil=nogil)
        return cast("Function", made)

    return decorate


def compiled(function: Function) -> Function:
    """Return the compiled function of a kernel, which is called without a Python frame.

    It is compiled now, or loaded from the cache. Any other function is returned unchanged.
    """
    return function.dispatcher if isinstance(function, _Kernel) else function


def ensure_compiled(*kernels: object) -> None:
    """Compile kernels now, or load them from the cache, so that their first call does not wait.

    Objects other than kernels are ignored.
    """
    for each in kernels:
        if isinstance(each, _Kernel):
            compiled(each)
