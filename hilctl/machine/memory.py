"""What a process has mapped, and which of it no tick needs.

A tick needs the interpreter, numpy's core, the compiled kernels, heap and stack. It needs no
compiler, BLAS or LAPACK: numba and numpy map those, 200 MB of them, and half of it stays resident
once the kernels are loaded. Nor does it read files, or check what stands in them.
"""

import ctypes
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_NOT_IN_A_TICK = (
    "libllvmlite",
    "openblas",
    "libgfortran",
    "libquadmath",
    "libstdc++",
    "/numpy/linalg/",
    "/numpy/fft/",
    "/scipy/",
    "libcrypto",
    "_pydantic_core",
    "/_yaml",
    "/unicodedata.",
    "/_decimal.",
    "/locale/",
)
_AS_FAR_AS_TOUCHED = ("[heap]", "/numpy/random/")
_RESERVED_BYTES = 8 << 20  # stacks of threads and BLAS' buffers are reserved, and never filled
_LOCK_ON_FAULT = 7  # MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT
_DONTNEED = 4
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_KEPT_BYTES = 1 << 19
_SMAPS = Path("/proc/self/smaps")


@dataclass(frozen=True, slots=True)
class Mapping:
    """A range of addresses of this process.

    Attributes:
        start: Its first address.
        size: Its bytes.
        access: As in ``/proc/self/maps``: ``r-xp``.
        path: What stands there: a file, ``[heap]``, or empty for memory of no file.
        resident: Bytes of it in RAM.
        changed: Bytes of it that no file has.
    """

    start: int
    size: int
    access: str
    path: str
    resident: int
    changed: int

    @property
    def in_a_tick(self) -> bool:
        """Whether a tick may need it."""
        return not any(part in self.path for part in _NOT_IN_A_TICK)

    @property
    def whole(self) -> bool:
        """Whether all of it is to be in RAM before the first tick."""
        readable = self.access[0] == "r" and not self.path.startswith("[v")  # the kernel's own
        touched = any(part in self.path for part in _AS_FAR_AS_TOUCHED)
        return readable and not touched and (self.of_file or self.size < _RESERVED_BYTES)

    @property
    def of_file(self) -> bool:
        """Whether what is not in RAM has to be read back from a file."""
        return self.path.startswith("/")


def mappings(smaps: Iterable[str]) -> Iterator[Mapping]:
    """Yield what the lines of ``/proc/self/smaps`` say."""
    head: list[str] = []
    sizes: dict[str, int] = {}
    for line in smaps:
        words = line.split()
        if words[0].endswith(":"):
            if words[-1] == "kB":
                sizes[words[0]] = int(words[1]) << 10
            continue
        if head:
            yield _mapping(head, sizes)
        head, sizes = line.split(maxsplit=5), {}
    if head:
        yield _mapping(head, sizes)


def _mapping(head: list[str], sizes: dict[str, int]) -> Mapping:
    start, stop = (int(part, 16) for part in head[0].split("-"))
    path = head[5].strip() if len(head) > 5 else ""
    return Mapping(start, stop - start, head[1], path, sizes["Rss:"], sizes["Anonymous:"])


def _own_mappings() -> list[Mapping]:
    with _SMAPS.open(encoding="utf-8", errors="surrogateescape") as lines:
        return list(mappings(lines))


class ProcessMemory:
    """The memory of this process, on Linux."""

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)

    def _call(self, name: str, *arguments: int) -> None:
        function: Any = getattr(self._libc, name)
        if function(*map(ctypes.c_size_t, arguments)) < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def release(self) -> None:
        """Give back the pages of what no tick needs; whoever needs one again reads it back.

        Only those that are as in their file: what the loader has put there is nowhere else. Where
        that is refused, they stay.
        """
        self._give_back([each for each in _own_mappings() if not each.in_a_tick])

    def _give_back(self, given: Iterable[Mapping]) -> None:
        if hasattr(self._libc, "malloc_trim"):  # glibc's: what was freed goes back, too
            self._libc.malloc_trim(0)
        for each in given:
            if each.of_file and each.resident and not each.changed:
                self._libc.madvise(*map(ctypes.c_size_t, (each.start, each.size, _DONTNEED)))

    def stay_small(self) -> None:
        """Give back what can be read again, and from now on what is freed: for who has no ticks.

        Half of what a process reads of its libraries it reads at its start only.
        """
        self._give_back(_own_mappings())
        if hasattr(self._libc, "mallopt"):
            # Unless they are set, glibc keeps twice the largest array that was ever freed.
            self._libc.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
            self._libc.mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)

    def lock(self) -> None:
        """Keep in RAM what a tick may need, all of it, now; and whatever else is ever touched.

        Raises:
            OSError: It is refused.
        """
        self.release()  # first: a locked page can't be given back
        self._call("mlockall", _LOCK_ON_FAULT)
        for each in _own_mappings():
            if not each.in_a_tick:
                self._call("munlock", each.start, each.size)
            elif each.whole:
                # A page that nothing has touched yet may have to come from a disk in a tick.
                self._call("mlock", each.start, each.size)
