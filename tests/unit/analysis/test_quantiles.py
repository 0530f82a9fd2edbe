"""Percentiles: exact of what fits, and within their bins of what does not."""

import numpy as np
import pytest

from hilctl.analysis import quantiles
from hilctl.analysis.quantiles import Quantiles

PERCENTS = [0.0, 10.0, 50.0, 90.0, 99.9]


def gathered(values, parts=7):
    found = Quantiles()
    for part in np.array_split(values, parts):
        found.add(part)
    return found


@pytest.fixture
def small(monkeypatch):
    """Let bins begin early."""
    monkeypatch.setattr(quantiles, "MOST_EXACT", 1000)


def kinds():
    rng = np.random.default_rng(1)
    yield rng.normal(size=5001)
    yield np.abs(rng.normal(size=5000)) * 1e-9
    yield rng.integers(-(10**6), 10**9, 5000)
    yield np.round(np.abs(rng.normal(size=5000)))  # most are zero
    yield np.where(rng.random(5000) < 0.4, 0.0, 10.0 ** rng.uniform(-300, 300, 5000))


VALUES = pytest.mark.parametrize("values", [*kinds()])


@VALUES
def test_what_fits_is_exact(values):
    found = gathered(values)
    assert found.percentiles(PERCENTS) == np.percentile(values, PERCENTS).tolist()
    assert found.median() == np.median(values)
    assert (found.size, found.largest) == (values.size, values.max())
    assert found.above(0.5) == np.count_nonzero(values > 0.5)


@VALUES
def test_what_does_not_is_within_its_bin(small, values):
    found = gathered(values)
    exact = np.percentile(values, PERCENTS, method="lower")
    assert found.percentiles(PERCENTS) == pytest.approx(exact.tolist(), rel=6.2e-5)
    assert found.largest == values.max()
    assert found.median() == found.percentiles([50.0])[0] == gathered(values, 3).median()
    assert found.above(0.4) == np.count_nonzero(values > 0.4)
