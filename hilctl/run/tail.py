"""The newest samples of a run, for the events that want to be told with what led to them."""

import numpy as np

from hilctl.base.samples import Batch, Samples

_SPARE = 20


class Tail:
    """Keeps at least the last samples, however they came.

    Args:
        samples: How many to record with an event.
    """

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._newest: Samples | None = None

    def add(self, batch: Batch) -> None:
        """Take the newest samples of a batch; more of them than are asked for, for late events."""
        kept = _SPARE * self._samples
        blocks = -(-kept // batch.flags.shape[1])
        newest = batch.samples(slice(-blocks, None))
        if self._newest is not None:
            newest = self._newest.followed_by(newest)
        self._newest = newest.rows(slice(-kept, None))

    def up_to(self, sample: int) -> Samples | None:
        """Return the last samples up to and with ``sample``; None where none is left."""
        if self._newest is None:
            return None
        stop = int(np.searchsorted(self._newest.index, sample, side="right"))
        return self._newest.rows(slice(max(0, stop - self._samples), stop)) if stop else None
