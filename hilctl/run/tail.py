"""The newest samples of a run, for the events that want to be told with what led to them."""

import numpy as np

from hilctl.base.arrays import F64, I64, U32
from hilctl.base.samples import COLUMNS, Batch, Head
from hilctl.recording.data import Samples

_SPARE = 20


class Tail:
    """Keeps at least the last samples, however they came.

    Args:
        samples: How many to tell with an event.
    """

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._index: I64 = np.empty(0, dtype=np.int64)
        self._columns: F64 = np.empty((len(COLUMNS), 0))
        self._flags: U32 = np.empty(0, dtype=np.uint32)

    def add(self, batch: Batch) -> None:
        """Take the newest samples of a batch; more of them than are told, for late events."""
        block = batch.flags.shape[1]
        blocks = -(-_SPARE * self._samples // block)
        rows = slice(-blocks, None)
        firsts = batch.heads[rows, Head.FIRST_SAMPLE]
        index = (firsts[:, None] + np.arange(block)).ravel()
        columns = batch.columns[rows].transpose(1, 0, 2).reshape(len(COLUMNS), -1)
        kept = slice(-_SPARE * self._samples, None)
        self._index = np.concatenate((self._index, index))[kept]
        self._columns = np.concatenate((self._columns, columns), axis=1)[:, kept]
        self._flags = np.concatenate((self._flags, batch.flags[rows].ravel()))[kept]

    def up_to(self, sample: int) -> Samples | None:
        """Return the last samples up to and with ``sample``; None where none is left."""
        stop = int(np.searchsorted(self._index, sample, side="right"))
        rows = slice(max(0, stop - self._samples), stop)
        if stop == 0:
            return None
        reference, wanted, command, displacement_um = self._columns[:4, rows]
        return Samples(
            self._index[rows],
            reference,
            wanted,
            command,
            np.empty(0),
            displacement_um,
            self._flags[rows],
        )
