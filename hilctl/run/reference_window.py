"""A reference that does not fit in memory, worked out ahead of the loop.

A process of its own does so in a paced run, forked from the supervisor before that holds a lock, a
recording or a thread. It opens no file but the window's, so no disk keeps it waiting; a loop that
comes to samples which are not there ends by its safe ramp.
"""

import multiprocessing
import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import RunError
from hilctl.base.values import Values, in_memory
from hilctl.experiment.check import Checked
from hilctl.loop.window import window_size
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, SharedPage
from hilctl.run.stopping import HANG_UP, JOB_CONTROL, STOP_SIGNAL

_PIECE = 1 << 16
_POLL_S = 0.02
_DEATH_S = 1.0
_SUPERVISORS = (signal.SIGINT, signal.SIGTERM, HANG_UP, STOP_SIGNAL, *JOB_CONTROL)
"""Signals that may be sent to all of a run's processes, and are the supervisor's to follow."""


class WindowFiller:
    """Fills a window, some of its samples at a time.

    Args:
        reference: All of the reference.
        input_um: All of the compensator's input; the reference itself where that is it.
        arrays: The window's reference and input, float64[w] each; the same array where they are.
        ready: Samples that are in it already.
    """

    def __init__(
        self, reference: Values, input_um: Values, arrays: tuple[F64, F64], ready: int = 0
    ) -> None:
        self._signals = [(reference, arrays[0])]
        if arrays[1] is not arrays[0]:
            self._signals.append((input_um, arrays[1]))
        self.samples, self._size = reference.size, arrays[0].size
        self.ready = ready
        """Samples that have been there so far."""

    def fill(self, used: int) -> bool:
        """Go on by a piece; return whether there was room for one.

        Args:
            used: Samples that nobody needs any more.
        """
        start = self.ready
        room = min(self.samples, used + self._size) - start
        n = min(room, _PIECE, self._size - start % self._size)
        if n <= 0:
            return False
        for values, window in self._signals:
            at = start % self._size
            window[at : at + n] = values[start : start + n]
        self.ready = start + n
        return True


class OwnWindow:
    """A window that its loop's own process fills; see :class:`hilctl.loop.window.Window`.

    Args:
        filler: Fills it.
        block: Samples in a block.
    """

    def __init__(self, filler: WindowFiller, block: int) -> None:
        self._filler, self._block = filler, block
        self.samples = filler.samples

    def has(self, stop: int) -> bool:
        """Fill it where samples before ``stop`` are missing; return whether they are there."""
        if stop > self._filler.ready:
            while self._filler.fill(stop - self._block):
                pass
        return stop <= self._filler.ready


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a window is: the run's ring, and files of the reference and of the input."""

    ring: Path
    reference: Path
    input_um: Path


class ReferenceProcess:
    """The process that fills a run's window, seen from the supervisor; none where there is none.

    Args:
        checked: The experiment.
    """

    def __init__(self, checked: Checked) -> None:
        config, values = checked.loaded.config, checked.reference.values
        self._size = window_size(config.block, config.sample_rate_hz)
        self._needed = not in_memory(values)
        if not self._needed:
            return
        # Forked on purpose: so it has the checked experiment, at no cost of time or memory.
        fork = multiprocessing.get_context("fork")
        self._connection, theirs = fork.Pipe()
        args = (theirs, self._connection, values, checked.begun.input_um)
        self._process = fork.Process(target=_work, args=args, daemon=True)
        # Held back until it ignores them: one that comes in between would end it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _SUPERVISORS)
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._needed:
            self._process.kill()  # it holds nothing
            self._process.join(_DEATH_S)
            self._connection.close()

    def begin(self, folder: RunFolder, page: SharedPage) -> None:
        """Have the window in a run's folder filled ahead of its loop; it is full already.

        Args:
            folder: The run's.
            page: Of its ring.

        Raises:
            RunError: The process is gone.
        """
        if not self._needed:
            return
        page.put(Field.REFERENCE_READY, self._size)  # before the process, which goes on from there
        try:
            self._connection.send(_Place(folder.ring, folder.reference, folder.input_um))
        except OSError:
            raise RunError("the process that works the reference out is gone") from None


def _work(
    connection: Connection, supervisors: Connection, reference: Values, input_um: Values
) -> None:
    """Fill a window until all of the reference has been there, or the supervisor is gone."""
    supervisors.close()  # else the end of its side would never show
    for number in _SUPERVISORS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SUPERVISORS)
    supervisor = os.getppid()
    with suppress(EOFError, OSError):
        place: _Place = connection.recv()
        page = SampleRing(place.ring).page
        window = np.load(place.reference, mmap_mode="r+")
        own = input_um is not reference
        arrays = window, np.load(place.input_um, mmap_mode="r+") if own else window
        filler = WindowFiller(reference, input_um, arrays, page.get(Field.REFERENCE_READY))
        while filler.ready < filler.samples and os.getppid() == supervisor:
            if filler.fill(page.get(Field.NEXT_SAMPLE)):
                # The samples first: the number says that they are there.
                page.publish(Field.REFERENCE_READY, filler.ready)
            else:
                time.sleep(_POLL_S)
