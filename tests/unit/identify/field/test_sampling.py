"""Rows of a fit: where they lie, and how much each of them counts."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.field.sampling import LEAST_SWING, Motion, chosen

RATE_HZ = 10_000.0


def sine(amplitude: float, frequency_hz: float, seconds: float) -> F64:
    """Return a sine of whole cycles."""
    return amplitude * np.sin(
        2.0 * np.pi * frequency_hz * np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    )


def motion(command: F64, judged: int = 0) -> Motion:
    """Return the motion of a command of 6 at most that a displacement follows by 3 um a unit."""
    step_s = np.full(command.size, 1.0 / RATE_HZ)
    return Motion.of((command, 3.0 * command), step_s, judged, 6.0, 36.0)


def counts(command: F64, most: int, cuts: list[int]) -> tuple[list[int], list[float]]:
    """Return how many rows there are in each part of a command, and their weight."""
    rows = chosen([motion(command)], most)
    parts = np.searchsorted(rows.samples[0], cuts)
    weights = np.split(rows.scale**2, parts)
    return [part.size for part in weights], [float(part.sum()) for part in weights]


def test_small_loops_weigh_what_their_own_size_makes_of_an_error() -> None:
    """Of the same time and number of cycles: the square of the inverse of their size."""
    both = np.concatenate((sine(6.0, 20.0, 1.0), sine(2.0, 20.0, 1.0)))
    (large, small), (one, other) = counts(both, 2000, [10_000])
    assert large == pytest.approx(small, rel=0.05)
    assert other / one == pytest.approx(9.0, rel=0.1)


def test_no_swing_weighs_more_than_the_smallest_that_counts() -> None:
    tiny = [sine(part * LEAST_SWING * 6.0, 20.0, 1.0) for part in (0.9, 0.3)]
    _, (_, one, other) = counts(
        np.concatenate((sine(6.0, 20.0, 1.0), *tiny)), 3000, [10_000, 20_000]
    )
    assert other < 1.1 * one


def test_a_fast_loop_does_not_weigh_by_its_cycles_nor_a_slow_one_by_its_time() -> None:
    """A hundred cycles in a second and two in two: taken by travel or by time they differ much."""
    both = np.concatenate((sine(6.0, 100.0, 1.0), sine(6.0, 1.0, 2.0)))
    _, (fast, slow) = counts(both, 2000, [10_000])
    assert 0.4 < slow / fast < 2.5


def test_a_rest_has_neither_rows_nor_weight() -> None:
    still = np.concatenate((sine(6.0, 20.0, 1.0), np.zeros(100_000)))
    assert counts(still, 1000, [10_000])[0] == [1000 - 1, 0]


@pytest.mark.parametrize("judged", [0, 50, 4001])
def test_rows_are_samples_that_count(judged: int) -> None:
    rows = chosen([motion(sine(6.0, 20.0, 1.0), judged), motion(sine(1.0, 10.0, 1.0))], 500)
    first, second = rows.samples
    assert first.min() >= judged
    assert (np.diff(first) > 0).all()
    assert (np.diff(second) > 0).all()
    assert first.size + second.size == rows.scale.size <= 500
    assert np.mean(rows.scale**2) == pytest.approx(1.0)


def test_more_rows_are_no_more_weight_for_any_of_them() -> None:
    command = np.concatenate((sine(6.0, 20.0, 1.0), sine(1.0, 5.0, 1.0)))
    few, more = counts(command, 400, [10_000])[1], counts(command, 4000, [10_000])[1]
    assert np.divide(few, sum(few)) == pytest.approx(np.divide(more, sum(more)), abs=0.03)


def test_a_thinned_motion_is_the_same_way_and_time() -> None:
    whole = motion(sine(6.0, 20.0, 1.0), judged=101)
    kept = np.arange(0, 10_000, 7)
    few = whole.at(kept)
    assert few.travel.sum() == pytest.approx(whole.travel[: kept[-1] + 1].sum())
    assert few.step_s.sum() == pytest.approx(whole.step_s[: kept[-1] + 1].sum())
    assert few.swing.tolist() == whole.swing[kept].tolist()
    assert kept[few.judged - 1] < 101 <= kept[few.judged]
