"""Late ticks, counted and as percentiles."""

import numpy as np

from hilctl.base.samples import Batch, Head
from hilctl.desk.lateness import EDGES_US, LatenessCounts


def test_every_tick_is_counted_once_whatever_its_lateness():
    counts = LatenessCounts()
    assert counts.percentiles_us() == {}
    batch = Batch.empty(5, 1, 1)
    batch.heads[:, Head.LATE_NS] = (-5, 0, 30_000, 30_000, 9_000_000_000)
    counts.add(batch)
    assert counts.counts.sum() == 5
    assert counts.counts[-1] == 1
    assert counts.counts[np.searchsorted(EDGES_US, 30.0) - 1] == 2
    assert counts.percentiles_us()["p50"] == 30.0
    assert counts.percentiles_us()["max"] == 9e6
