"""Linux system calls for real-time processes.

They act on the calling process; policy, CPU and timer slack on the calling thread. A refusal is an
:class:`OSError`.
"""

import ctypes
import errno
import gc
import os
from functools import cached_property
from pathlib import Path
from typing import Any

from hilctl.machine.procfs import CAP_IPC_LOCK, Machine

DMA_LATENCY = "/dev/cpu_dma_latency"

_STACK_DEPTH = 250
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4


def _go_down(depth: int) -> None:
    if depth:
        _descend(depth - 1)


_descend = ctypes.CFUNCTYPE(None, ctypes.c_int)(_go_down)
"""Uses 2 kB of the C stack per depth; pure Python would use none."""


class LinuxProcess:
    """This process, on Linux with glibc."""

    @cached_property
    def _libc(self) -> ctypes.CDLL:
        return ctypes.CDLL(None, use_errno=True)

    def _call(self, name: str, *arguments: int) -> None:
        function: Any = getattr(self._libc, name)
        if function(*map(ctypes.c_long, arguments)) < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def read(self, path: str) -> str:
        """Return the text of a file."""
        return Path(path).read_text(encoding="utf-8")

    def lockable_bytes(self) -> int | None:
        """Return how much memory may be locked; None if any amount."""
        machine = Machine()
        return None if machine.capable(CAP_IPC_LOCK) else machine.limit("Max locked memory")

    def mapped_bytes(self) -> int:
        """Return the size of all mapped memory."""
        return int(Machine().status("VmSize").removesuffix(" kB")) << 10

    def freeze_gc(self) -> None:
        """Collect garbage once, then disable collection."""
        gc.collect()
        gc.freeze()
        gc.disable()

    def prefault(self, heap_bytes: int) -> None:
        """Allocate and touch heap and stack; freed memory stays with the process."""
        mallopt: Any = getattr(self._libc, "mallopt", None)
        if mallopt is None:
            raise OSError(errno.ENOSYS, "this C library is not glibc")
        mallopt(_M_TRIM_THRESHOLD, -1)  # freed memory stays with the process,
        mallopt(_M_MMAP_MAX, 0)  # and large arrays come from it
        touched = b"\x01" * heap_bytes
        del touched
        _descend(_STACK_DEPTH)

    def lock_memory(self, *, untouched: bool = False) -> None:
        """Lock the pages in RAM now, and every page that is touched later.

        Args:
            untouched: Also read and lock pages that were never touched. In the loop process they
                would be 160 MB of LLVM and OpenBLAS.
        """
        on_fault = 0 if untouched else _MCL_ONFAULT
        self._call("mlockall", _MCL_CURRENT | _MCL_FUTURE | on_fault)

    def set_timer_slack(self, slack_ns: int) -> None:
        """Set the timer slack."""
        self._call("prctl", _PR_SET_TIMERSLACK, slack_ns, 0, 0, 0)

    def hold_dma_latency(self, latency_us: int) -> None:
        """Disable idle states with a longer exit latency."""
        descriptor = os.open(DMA_LATENCY, os.O_WRONLY)  # in force while the file is open
        try:
            os.write(descriptor, latency_us.to_bytes(4, "little", signed=True))
        except OSError:
            os.close(descriptor)
            raise

    def pin(self, cpu: int) -> None:
        """Run on this CPU only."""
        os.sched_setaffinity(0, {cpu})

    def set_fifo(self, priority: int) -> None:
        """Use SCHED_FIFO; children and new threads start without it."""
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))

    def set_ordinary(self) -> None:
        """Use SCHED_OTHER."""
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))

    def policy(self, process: int = 0) -> int:
        """Return the scheduling policy of a process, by default this one."""
        return os.sched_getscheduler(process) & ~os.SCHED_RESET_ON_FORK

    def nice(self) -> int:
        """Return the nice value of this thread."""
        return os.getpriority(os.PRIO_PROCESS, 0)

    def set_nice(self, nice: int) -> None:
        """Set the nice value of this thread; new threads and processes inherit it."""
        os.setpriority(os.PRIO_PROCESS, 0, nice)
