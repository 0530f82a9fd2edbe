"""Buckets of lowest and highest values."""

import numpy as np
import pytest

from hilctl.desk.envelope import Envelope
from hilctl.desk.signals import SIGNALS, Traces


def traces(start, values, step=1):
    values = np.asarray(values, dtype=float)
    index = np.arange(start, start + step * values.size, step)
    rows = np.tile(values, (len(SIGNALS), 1))
    return Traces(index, rows, np.zeros(values.size, dtype=np.uint32))


@pytest.mark.parametrize("width", [1, 3, 7.5])
def test_each_sample_is_within_its_bucket_however_the_samples_come(width):
    """So one spike of one sample is seen, and the first value is that of a sample."""
    rng = np.random.default_rng(3)
    values = rng.standard_normal(400)
    values[137] = 50.0
    whole, parts = Envelope(5, width, 500), Envelope(5, width, 500)
    whole.add(traces(5, values))
    at = 0
    while at < 400:
        size = int(rng.integers(1, 40))
        parts.add(traces(5 + at, values[at : at + size]))
        at += size
    count = whole.newest + 1
    one, other = whole.window(0, count), parts.window(0, count)
    numbers = np.floor(np.arange(400) / width).astype(int)
    for bucket in range(count):
        mine = values[numbers == bucket]
        found = (one.low[0, bucket], one.high[0, bucket], one.first[0, bucket])
        assert found == (mine.min(), mine.max(), mine[0])
    assert one.high.max() == 50.0
    for name in ("low", "high", "first"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_gaps_and_what_is_gone_are_empty():
    envelope = Envelope(0, 2, 4)
    envelope.add(traces(0, [1.0, 2.0, 3.0, 4.0]))
    envelope.add(traces(8, [5.0]))
    found = envelope.window(0, 6).low[0]
    assert np.isnan(found).tolist() == [True, False, True, True, False, True]
    envelope.add(traces(1000, [6.0]))
    assert np.isnan(envelope.window(497, 4).low[0]).tolist() == [True, True, True, False]


def test_a_value_that_is_missing_hides_no_other():
    envelope = Envelope(0, 3, 4)
    envelope.add(traces(0, [np.nan, 2.0, 7.0, np.nan, np.nan, np.nan]))
    found = envelope.window(0, 2)
    assert (found.low[0, 0], found.high[0, 0]) == (2.0, 7.0)
    assert np.isnan(found.low[0, 1])


def test_what_comes_before_the_origin_is_left():
    envelope = Envelope(10, 1, 4)
    envelope.add(traces(7, [1.0, 2.0]))
    assert envelope.newest == -1
    envelope.add(traces(9, [3.0, 4.0]))
    assert envelope.window(0, 1).low[0].tolist() == [4.0]
