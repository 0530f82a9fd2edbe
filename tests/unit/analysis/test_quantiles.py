"""Percentiles: exact up to a number of values, and of a share of more."""

import numpy as np
import pytest

from hilctl.analysis import quantiles
from hilctl.analysis.quantiles import Quantiles

PERCENTS = [0.0, 10.0, 50.0, 90.0, 99.9]
VALUES = np.random.default_rng(1).permutation(200_000) * 1e-3


def gathered(values, parts=7):
    found = Quantiles()
    for part in np.array_split(values, parts):
        found.add(part)
    return found


def test_few_values_are_exact():
    found = gathered(VALUES)
    assert found.percentiles(PERCENTS) == np.percentile(VALUES, PERCENTS).tolist()
    assert found.median() == np.median(VALUES)
    assert (found.size, found.largest) == (VALUES.size, VALUES.max())
    assert found.above(150.0) == np.count_nonzero(VALUES > 150.0)


@pytest.mark.parametrize("parts", [1, 7, 1999])
def test_percentiles_of_many_values_are_those_of_every_nth(monkeypatch, parts):
    monkeypatch.setattr(quantiles, "MOST_EXACT", 30_000)
    found = gathered(VALUES, parts)
    assert found.percentiles(PERCENTS) == np.percentile(VALUES[::8], PERCENTS).tolist()
    assert found.median() == pytest.approx(100.0, rel=0.02)
    assert (found.size, found.largest) == (VALUES.size, VALUES.max())
    assert found.above(150.0) == pytest.approx(50_000, rel=0.02)
