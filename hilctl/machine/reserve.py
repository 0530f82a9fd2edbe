"""A reserve of threads and descriptors, to write safe values when no more are available."""

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from threading import Event, Semaphore, Thread

try:
    import resource
except ImportError:  # Windows, where no runs take place
    resource = None  # type: ignore[assignment]

_DESCRIPTORS = 8
"""Opening a serial port takes six."""


class Reserve:
    """The threads and descriptors that a process reserves; one per process, see :data:`RESERVE`."""

    def __init__(self) -> None:
        self.threads: list[Thread] = []
        """The held threads."""
        self._descriptors: list[int] = []
        self._work: SimpleQueue[tuple[Callable[[], object], Event]] = SimpleQueue()
        self._idle = Semaphore(0)

    def hold(self, lines: int = 1) -> None:
        """Acquire what so many lines need, unless that was done.

        Raise OSError or RuntimeError if it fails.
        """
        for _ in range(lines - len(self.threads)):
            self._descriptors += [os.open(os.devnull, os.O_RDONLY) for _ in range(_DESCRIPTORS)]
            # A new thread would need memory. A daemon, so that a blocked one does not keep the
            # process.
            thread = Thread(target=self._serve, name="reserve", daemon=True)
            thread.start()
            self.threads.append(thread)

    def run(self, work: Callable[[], object]) -> Event:
        """Call ``work`` in a held thread; in a new one if all are busy, or none is held.

        Return an event that is set afterwards. Raise RuntimeError if no thread can be started.
        """
        ended = Event()
        if self._idle.acquire(blocking=False):
            self._work.put((work, ended))
        else:
            Thread(target=_call, args=(work, ended), name="safe action", daemon=True).start()
        return ended

    def release(self) -> bool:
        """Free the descriptors and standard input; return False if none are held.

        If the limit of descriptors is below the numbers in use, closing those above it frees none.
        So the limit is raised as far as allowed, and closing standard input frees number 0.
        """
        if not self._descriptors:
            return False
        for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_AS):
            with suppress(OSError, ValueError):
                hard = resource.getrlimit(kind)[1]
                resource.setrlimit(kind, (hard, hard))
        own_input = [] if sys.__stdin__ is None else [0]
        while spare := self._descriptors or own_input:
            with suppress(OSError):
                os.close(spare.pop())
        return True

    def _serve(self) -> None:
        while True:
            self._idle.release()
            _call(*self._work.get())


def _call(work: Callable[[], object], ended: Event) -> None:
    try:
        work()
    finally:
        ended.set()


RESERVE = Reserve()
"""The reserve of this process."""
