"""Windows and loops of a scope."""

import numpy as np
import pytest

from hilctl.base.samples import COLUMNS, BlockBatch, Flag
from hilctl.base.segments import Segment
from hilctl.live.scope import BUCKETS, ROW, SIGNALS, WINDOWS_S, MinMaxTrace, Scope, traces_of
from tests.unit.live.conftest import traces

RATE = 1000.0


def waves(start, stop, period, flags=0):
    phase = 2 * np.pi * (np.arange(start, stop) - 100) / period
    error = np.zeros(phase.size)
    return traces(start, flags, reference=np.sin(phase), displacement=np.cos(phase), error=error)


def segment(period, stop=100_000):
    return Segment("sine", 100, stop, 100, stop, period)


@pytest.mark.parametrize("period", [50.0, 33.4])
def test_a_triggered_window_begins_with_the_cycle(period):
    scope = Scope(RATE, [segment(period)], "reference")
    scope.add(waves(0, 100, period, int(Flag.RAMP)))
    assert scope.triggered() is None
    for start, stop in ((100, 400), (400, 411), (411, 433)):
        scope.add(waves(start, stop, period))
        window = scope.triggered()
        expected = np.sin(2 * np.pi * window.t_s * RATE / period)
        assert window.buckets.low[ROW["reference"]] == pytest.approx(expected, abs=1e-9)
        assert 0.0 <= window.t_s[0] < 1.0 / RATE
        assert window.t_s[-1] == pytest.approx(2 * period / RATE, abs=1.01 / RATE)


def test_long_cycle_is_shown_while_recorded():
    period = 5000.0
    scope = Scope(RATE, [segment(period)], "reference")
    scope.add(waves(100, 100 + 7500, period))
    shown = scope.triggered().buckets.low[ROW["reference"]]
    there = np.isfinite(shown)
    assert there[: int(0.74 * shown.size)].all()
    assert not there[int(0.76 * shown.size) :].any()


@pytest.mark.parametrize("window_s", WINDOWS_S)
def test_rolling_window_has_every_spike(window_s):
    scope = Scope(RATE, [segment(50.0)], "reference")
    samples = waves(100, 8000, 50.0)
    samples.values[ROW["error"], -9] = 30.0
    scope.add(samples)
    window = scope.rolling(window_s)
    assert window.t_s[-1] == 0.0
    assert window.t_s.size <= BUCKETS
    assert np.nanmax(window.buckets.high[ROW["error"]]) == 30.0


def test_loops_pair_one_samples_values():
    scope = Scope(RATE, [segment(50.0)], "reference")
    scope.add(waves(100, 1000, 50.0))
    loops = scope.loops()
    assert loops.shape == (2, 6 * 50)
    assert np.hypot(*loops) == pytest.approx(np.ones(300))
    assert scope.points_a_cycle() == 50


def test_last_steady_cycle_stays():
    """Neither the soft end nor the safe ramp replaces it."""
    soft = Segment("sine", 100, 1000, 100, 900, 50.0)
    scope = Scope(RATE, [soft], "reference")
    scope.add(waves(100, 900, 50.0))
    before = scope.triggered().buckets.low, scope.loops()
    scope.add(waves(900, 1000, 50.0))
    scope.add(waves(1000, 1100, 50.0, int(Flag.RAMP)))
    np.testing.assert_array_equal(scope.triggered().buckets.low, before[0])
    np.testing.assert_array_equal(scope.loops(), before[1])


def test_cycle_of_each_segment():
    first = Segment("a", 0, 500, 0, 500, 50.0)
    scope = Scope(RATE, [first, Segment("b", 500, 9000, 500, 9000)], "reference")
    scope.add(waves(0, 400, 50.0))
    assert scope.segment.label == "a"
    scope.add(waves(400, 900, 50.0))
    assert scope.segment.label == "b"
    assert scope.triggered() is None
    assert scope.loops().shape[1] > 30


def test_nothing_is_shown_before_the_first_sample():
    scope = Scope(RATE, [segment(50.0)], "reference")
    assert scope.loops().shape == (2, 0)
    assert np.isnan(scope.rolling(0.5).buckets.low).all()


@pytest.mark.parametrize("width", [1, 3, 7.5])
def test_buckets_do_not_depend_on_chunk_size(width):
    rng = np.random.default_rng(3)
    values = rng.standard_normal(400)
    values[137] = 50.0
    whole, parts = MinMaxTrace(5, width, 500), MinMaxTrace(5, width, 500)
    whole.add(traces(5, reference=values))
    for part in np.split(np.arange(400), np.cumsum(rng.integers(1, 40, size=19))):
        if part.size:
            parts.add(traces(5 + part[0], reference=values[part]))
    count = whole.newest + 1
    one, other = whole.window(0, count), parts.window(0, count)
    numbers = np.floor(np.arange(400) / width).astype(int)
    for bucket in range(count):
        mine = values[numbers == bucket]
        found = (one.low[0, bucket], one.high[0, bucket], one.first[0, bucket])
        assert found == (mine.min(), mine.max(), mine[0])
    assert one.high[0].max() == 50.0
    for name in ("low", "high", "first"):
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)


def test_gaps_and_overwritten_buckets_are_empty():
    envelope = MinMaxTrace(0, 2, 4)
    envelope.add(traces(0, reference=[1.0, 2.0, 3.0, 4.0]))
    envelope.add(traces(8, reference=[5.0]))
    found = envelope.window(0, 6).low[0]
    assert np.isnan(found).tolist() == [True, False, True, True, False, True]
    envelope.add(traces(1000, reference=[6.0]))
    assert np.isnan(envelope.window(497, 4).low[0]).tolist() == [True, True, True, False]


def test_missing_value_does_not_hide_others():
    envelope = MinMaxTrace(0, 3, 4)
    envelope.add(traces(0, reference=[np.nan, 2.0, 7.0, np.nan, np.nan, np.nan]))
    found = envelope.window(0, 2)
    assert (found.low[0, 0], found.high[0, 0]) == (2.0, 7.0)
    assert np.isnan(found.low[0, 1])


def test_samples_before_the_origin_are_ignored():
    envelope = MinMaxTrace(10, 1, 4)
    envelope.add(traces(7, reference=[1.0, 2.0]))
    assert envelope.newest == -1
    envelope.add(traces(9, reference=[3.0, 4.0]))
    assert envelope.window(0, 1).low[0].tolist() == [4.0]


def batch():
    made = BlockBatch.empty(2, 2, 1)
    made.heads[:, 1] = (10, 14)
    made.columns[:] = np.arange(float(len(COLUMNS)))[None, :, None]
    return made


def test_error_is_displacement_minus_reference():
    traces = traces_of(batch(), "um")
    assert traces.index.tolist() == [10, 11, 14, 15]
    assert traces.values[:, 0].tolist() == [0.0, 3.0, 3.0, 2.0, 4.0, 1.0]
    assert len(SIGNALS) == 6


def test_reference_in_another_unit_has_no_error():
    traces = traces_of(batch(), "A")
    assert np.isnan(traces.values[[ROW["reference"], ROW["error"]]]).all()
    assert np.isfinite(traces.values[ROW["displacement"]]).all()


def test_infinite_values_are_missing():
    made = batch()
    made.columns[0, 3, 0] = np.inf
    assert np.isnan(traces_of(made, "um").values[ROW["displacement"], 0])


def test_a_part_is_by_sample_index():
    assert traces_of(batch(), "um").part(11, 15).index.tolist() == [11, 14]
