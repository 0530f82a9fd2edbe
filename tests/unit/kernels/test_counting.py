"""Sums and counts in one pass: the bits of what NumPy does in many."""

import numpy as np
import pytest

from hilctl.analysis import quantiles
from hilctl.base import metrics
from hilctl.kernels.counting import count_keys

RNG = np.random.default_rng(3)
EVERY = np.arange(-40, 20_000)
SOME = EVERY[RNG.random(EVERY.size) < 0.7]


@pytest.mark.parametrize("period", [1.0, 16.0, 997.0, 1000.0, 5000.0, 30_000.0])
@pytest.mark.parametrize("index", [EVERY, SOME, EVERY[7::3], EVERY[:0]])
def test_pairs_are_folded_alike(monkeypatch, period, index):
    """Behind gaps, and without samples of which one signal or the other is not finite."""
    signals = RNG.normal(size=(2, index.size))
    for row, none in enumerate((np.nan, np.inf)):
        signals[row, RNG.random(index.size) < 0.01] = none
    folds = []
    for many in (2**60, 0):
        monkeypatch.setattr(metrics, "_MANY", many)
        folding = metrics.Folding(period, 2)
        for part in np.array_split(np.arange(index.size), 3):
            folding.add(index[part], signals[:, part])
        folds.append(folding)
    one, other = folds
    assert one._counts.tolist() == other._counts.tolist()
    assert one._sums.tobytes() == other._sums.tobytes()


def test_only_pairs_of_whole_periods_are_folded_so(monkeypatch):
    """All else goes on as before, however much there is."""
    monkeypatch.setattr(metrics, "_MANY", 0)
    index, signals = np.arange(4000), RNG.normal(size=(3, 4000))
    for period, count in ((33.3, 2), (100.0, 1), (100.0, 3)):
        fold = metrics.fold(index, period, signals[:count])
        assert fold.signals.shape[0] == count
        assert fold.counts.sum() == 4000


def test_keys_rise_as_the_numbers_do():
    """From the lowest of all to the highest; only what is next to 0 is counted apart."""
    shift, middle = quantiles._SHIFT, quantiles._MIDDLE
    values = np.array([-np.inf, -1e300, -2.0, -1.0, -5e-324, 5e-324, 1.0, 2.0, 1e300, np.inf])
    places = []
    for value in values:
        counts = np.zeros(2 * middle, dtype=np.int64)
        zeros, low, high = count_keys(np.array([value]).view(np.int64), shift, counts)
        if zeros:
            assert (low, high) == (2 * middle, 0)
            places.append(middle)
        else:
            assert high == low + 1
            assert counts[low] == 1
            places.append(low)
    assert places == sorted(places)
    assert len(set(places)) == len(places)
    counts = np.zeros(2 * middle, dtype=np.int64)
    zeros, low, high = count_keys(values.view(np.int64), shift, counts)
    assert (low, high) == (min(places), max(places) + 1)
    assert zeros + counts.sum() == values.size
