"""The one decorator of all kernels."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache, NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys

from hilctl.base.private import private_folder, user_folders

_NUMBA: Any = numba.config
Function = TypeVar("Function", bound=Callable[..., object])

STAGE = "void(float64[::1], float64[::1], float64[::1], float64[::1])"
"""Signature of a kernel whose parameters stand in one array: input, parameters, memory, output.

Output and input may be one array.
"""


def kernel(
    *signatures: str, inline: bool = False, nogil: bool = False
) -> Callable[[Function], Function]:
    """Compile a function for the given signatures only, and keep the result on disk.

    That happens at its first call, or by :func:`load`: a process reads only what it needs of all
    kernels, which would take it half of its start. Explicit signatures refuse any other type at
    once instead of compiling anew in the middle of a run; ``error_model="numpy"`` drops the
    division checks; ``fastmath`` stays off, so that results have the same bits wherever IEEE
    arithmetic holds.

    Where neither the package nor the user has a folder that can be written, or the disk is full,
    the result is kept in memory for as long as the machine runs, or not at all.

    Where numba is told not to compile (``NUMBA_DISABLE_JIT=1``: for a debugger, or to see what
    tests reach), the function is left as it is.

    Args:
        signatures: numba signatures, for example ``"void(float64[::1], float64[::1])"``.
        inline: Always merge it into the kernels that call it: for those called once a sample.
            Such a kernel must not use an array inside ``if`` or leave a loop by ``break``; numba
            then counts references to its arrays at every call, which takes longer than the work.
        nogil: Leave the interpreter to other threads meanwhile: for long work beside which others
            go on. No other thread may change its arrays then.

    Returns:
        A decorator that keeps the function's Python type.
    """

    def decorate(function: Function) -> Function:
        if _NUMBA.DISABLE_JIT:
            return function
        return cast("Function", _Kernel(function, signatures, inline=inline, nogil=nogil))

    return decorate


def load(*kernels: Callable[..., object]) -> None:
    """Compile kernels now, or read them from the disk, where their first call must not wait.

    Raises:
        numba.TypingError: A kernel is not what its signatures say.
    """
    for each in kernels:
        if isinstance(each, _Kernel):
            each.load()


def entry(each: Function) -> Function:
    """Return a kernel of one signature as a function that does not look up its arguments' types.

    Calling it takes half the time. Nothing refuses arrays of other types: for callers that make
    what they pass. Where numba is told not to compile, it is the function itself.
    """
    return cast("Function", each.only().entry_point) if isinstance(each, _Kernel) else each


def compile_by(other: Callable[[str, str], None] | None) -> None:
    """Have what is not on the disk compiled by somebody else from now on; None for here again.

    Args:
        other: Compiles and keeps a kernel, by its module and its name there. Where that can't be
            had, the kernel is compiled here all the same.
    """
    _Elsewhere.compile = other


class _Elsewhere:
    compile: Callable[[str, str], None] | None = None


class _Kept(FunctionCache):
    """Where the compiled forms of a function are kept."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is kept for a signature; None where nothing is.

        numba's own first registers all that can be compiled, which takes a process 0.2 s and 40 MB.
        What is compiled already needs only numba's runtime to be linked with, and the compiler does
        the rest where it comes to that.
        """
        kept = self._read(sig, target_context)
        if kept is None and _Elsewhere.compile is not None:
            _Elsewhere.compile(self._py_func.__module__, self._py_func.__qualname__)
            kept = self._read(sig, target_context)
        return kept

    def _read(self, sig: Any, target_context: Any) -> Any:
        # A file that a power loss has cut raises anything at all. With an empty index instead of
        # the damaged one the kernel is compiled again, and its files are replaced.
        with suppress(Exception):
            try:
                guarded, load_kept = self._guard_against_spurious_io_errors, self._load_overload
            except AttributeError:  # a numba that has it otherwise
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            rtsys.initialize(target_context)
            with guarded():
                return load_kept(sig, target_context)  # type: ignore[no-untyped-call]
            return None
        self.flush()  # type: ignore[no-untyped-call]
        return None


class _Kernel(CPUDispatcher):
    """A compiled function that has its declared signatures, from its first use on."""

    def __init__(
        self,
        function: Callable[..., object],
        signatures: tuple[str, ...],
        *,
        inline: bool,
        nogil: bool,
    ) -> None:
        options = {"nopython": True, "error_model": "numpy", "forceinline": inline, "nogil": nogil}
        super().__init__(function, targetoptions=options)
        self._declared = signatures
        self._loaded = False

    def load(self) -> None:
        with global_compiler_lock:
            if not self._loaded:
                with _without_blas(), _in_some_folder():
                    self._compile_declared()
                self.disable_compile()
                self._loaded = True

    def only(self) -> Any:
        """Return what its one signature was compiled to."""
        self.load()
        (compiled,) = self.overloads.values()
        return compiled

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
        kept: Any = _Kept
        self._cache = kept(self.py_func)
        done: Any
        for done in self.overloads.values():  # what the folder before had no room for
            self._cache.save_overload(done.signature, done)
        self._compile_all()

    def _compile_all(self) -> None:
        for signature in self._declared:
            self.compile(signature)


@contextmanager
def _without_blas() -> Iterator[None]:
    """Keep numba from importing SciPy's BLAS, for products of matrices that no kernel has.

    It does so with the first kernel of a process, in 0.2 s and 14 MB, and does without where SciPy
    can't be imported.
    """
    name = "scipy.linalg"
    if name in sys.modules:
        yield
        return
    blocked: dict[str, Any] = {name: None}  # which Python takes for a module that is not there
    sys.modules.update(blocked)
    try:
        yield
    finally:
        del sys.modules[name]


@contextmanager
def _in_some_folder() -> Iterator[None]:
    """Stand in the root folder meanwhile where the working folder has been deleted.

    numba gives places in the source by their way from the working folder.
    """
    try:
        Path.cwd()
    except FileNotFoundError:
        gone = os.open(".", os.O_RDONLY)
        os.chdir("/")
        try:
            yield
        finally:
            os.fchdir(gone)
            os.close(gone)
    else:
        yield


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
