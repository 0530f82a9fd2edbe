"""Count the wake-up lateness of the ticks of a run."""

import numpy as np

from hilctl.base.arrays import F64, I64
from hilctl.base.samples import Batch, Head

EDGES_US: F64 = np.concatenate(([0.0], np.geomspace(1.0, 1e6, 31)))
"""Edges of the histogram's bins; what is later is in the last one."""
_TICKS = 20_000


class LatenessCounts:
    """Histogram of all ticks read, and percentiles of the newest ticks."""

    def __init__(self) -> None:
        self.counts: I64 = np.zeros(EDGES_US.size - 1, dtype=np.int64)
        self._newest_us: F64 = np.empty(0)

    def add(self, batch: Batch) -> None:
        """Add the next blocks."""
        late_us = np.maximum(batch.heads[:, Head.LATE_NS] * 1e-3, 0.0)
        self.counts += np.histogram(np.minimum(late_us, EDGES_US[-1]), EDGES_US)[0]
        self._newest_us = np.concatenate((self._newest_us, late_us))[-_TICKS:]

    def percentiles_us(self) -> dict[str, float]:
        """Return ``p50``, ``p99`` and ``max`` of the newest ticks; empty before the first."""
        if not self._newest_us.size:
            return {}
        p50, p99, most = np.percentile(self._newest_us, (50.0, 99.0, 100.0))
        return {"p50": float(p50), "p99": float(p99), "max": float(most)}
