"""Lateness of ticks."""

import numpy as np
import pytest

from hilctl.analysis import tick_lateness
from hilctl.analysis.tick_lateness import LatenessBuilder, Quantiles
from hilctl.recording.recording import Ticks


def ticks(late_ns: list[int], period_ns: int = 1_000_000) -> Ticks:
    first = np.arange(len(late_ns), dtype=np.int64)
    late = np.array(late_ns, dtype=np.int64)
    return Ticks(first, first * period_ns, late, late)


def lateness(ticks: Ticks, minutes: float = 1.0) -> LatenessBuilder:
    builder = LatenessBuilder(minutes)
    builder.add(ticks)
    return builder


def test_percentiles_are_in_microseconds() -> None:
    found = lateness(ticks([1_000 * k for k in range(1, 1002)]))
    expected = {"p50": 501.0, "p90": 901.0, "p99": 991.0, "p99.9": 1000.0, "max": 1001.0}
    for times_ns in (found.late_ns, found.exchange_ns):
        assert tick_lateness.percentiles_us(times_ns) == pytest.approx(expected)
    assert tick_lateness.percentiles_us(lateness(ticks([])).late_ns) == {}


def test_minutes_are_evaluated_separately() -> None:
    run = ticks([1_000] * 60 + [2_000] * 60 + [5_000] * 10, period_ns=1_000_000_000)
    run.deadline_ns[120:] += 60_000_000_000
    found = lateness(run).by_minute()
    assert [(each["minute"], each["ticks"]) for each in found] == [(0, 60), (1, 60), (3, 10)]
    assert [each["max"] for each in found] == [1.0, 2.0, 5.0]
    assert lateness(ticks([])).by_minute() == []


def test_long_runs_have_longer_intervals() -> None:
    deadline_ns = np.arange(500_000, dtype=np.int64) * 60_000_000_000
    zeros = np.zeros_like(deadline_ns)
    rows = lateness(Ticks(zeros, deadline_ns, zeros, zeros), 500_000.0).by_minute()
    assert len(rows) <= tick_lateness.MOST_ROWS + 1
    assert sum(row["ticks"] for row in rows) == 500_000


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


@pytest.mark.parametrize("parts", [1, 7, 1999])
def test_percentiles_of_many_values_are_those_of_every_nth(monkeypatch, parts):
    monkeypatch.setattr(tick_lateness, "MOST_EXACT", 30_000)
    found = gathered(VALUES, parts)
    assert found.percentiles(PERCENTS) == np.percentile(VALUES[::8], PERCENTS).tolist()
    assert found.median() == pytest.approx(100.0, rel=0.02)
    assert (found.size, found.largest) == (VALUES.size, VALUES.max())
