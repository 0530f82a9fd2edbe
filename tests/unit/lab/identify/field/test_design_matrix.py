"""What the fit takes plays for is what the model makes of them."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.lab.identify.field.densities import Grid, table
from hilctl.lab.identify.field.design_matrix import (
    LEAST_SWING,
    SMALL,
    Motion,
    chosen,
    corners,
    turning_points,
)
from hilctl.lab.identify.field.field_search import FINER, tabled
from hilctl.models.effective_field import FieldModel, OutputCurve

GRID = Grid(np.array([0.0, 0.7, 2.0]), -6.0, 12.0, 4, 2)
SLOPES = np.array([[2.0, 2.5, 3.0, 2.0], [0.5, 1.0, 1.0, 0.0], [0.0, 1.0, 2.0, 1.0]])


def path() -> np.ndarray:
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 1.0, 600)
    return 1.6 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (3.0, 7.0, 11.0)) * t


def test_columns_times_slopes_are_the_model():
    u = np.ascontiguousarray(path())
    line = OutputCurve(operators_um=(-1.0, 1.0), displacement_um=(-1.0, 1.0))
    model = FieldModel(
        thresholds=tuple(GRID.thresholds),
        lowest=GRID.lowest,
        cell=GRID.piece / FINER,
        slopes=tuple(map(tuple, tabled(SLOPES))),
        curve=line,
    )
    modelled = model.forward(1.0).process(u)
    rows = np.arange(u.size)
    columns = table([u], [rows], GRID)
    given = columns @ SLOPES.ravel()
    # The model's slopes are even in each of its cells, so that it is a line through the splines.
    assert given == pytest.approx(modelled, abs=0.02)


def test_turning_points_and_rows_are_enough_of_a_path():
    u = np.ascontiguousarray(path())
    kept = np.empty(u.size, dtype=np.int64)
    kept = kept[: turning_points(u, 1.5, 0.03, kept)].copy()
    assert kept.size < u.size / 5
    whole = table([u], [kept], GRID)
    few = table([np.ascontiguousarray(u[kept])], [np.arange(kept.size)], GRID)
    assert few == pytest.approx(whole, abs=0.02)


def test_noise_makes_no_turns():
    noise = 0.01 * np.sin(np.arange(300.0) ** 2)
    u = np.concatenate([np.linspace(0.0, 3.0, 100), np.full(100, 3.0), np.linspace(3.0, 2.0, 100)])
    out = np.empty(300, dtype=np.int64)
    kept = out[: turning_points(u + noise, 1.5, 0.05, out)]
    assert kept.size == 5
    assert (kept[0], kept[-1]) == (0, 299)
    assert np.ptp(u[kept]) == pytest.approx(3.0)  # with a sample of the rest, where it turns
    assert (np.diff(kept) > 0).all()


def test_straight_lines_between_corners_are_near_both_signals():
    x, y = path(), np.cos(np.linspace(0.0, 40.0, 600))
    kept = np.empty(600, dtype=np.int64)
    kept = kept[: corners(np.ascontiguousarray(x), y, 0.2, 0.03, 2, 40, kept)].copy()
    assert kept.size < 200
    assert (kept % 2 == 0).all()
    assert (kept[0], kept[-1]) == (0, 598)
    assert np.diff(kept).min() >= 2
    assert np.diff(kept).max() <= 40
    every = np.arange(599)
    # A line goes through its ends, which are themselves as far off as it is.
    assert np.abs(np.interp(every, kept, x[kept]) - x[:599]).max() < 2.0 * 0.2
    assert np.abs(np.interp(every, kept, y[kept]) - y[:599]).max() < 2.0 * 0.03


def test_corners_of_one_signal_alone_are_kept():
    still, edge = np.zeros(100), np.concatenate([np.zeros(50), np.arange(50.0)])
    kept = np.empty(100, dtype=np.int64)
    for x, y in ((still, edge), (edge, still)):
        count = corners(x, y, 0.1, 0.1, 1, 1000, kept)
        assert kept[:count].tolist() == [0, 50, 99]


RATE_HZ = 10_000.0


def sine(amplitude: float, frequency_hz: float, seconds: float) -> F64:
    return amplitude * np.sin(
        2.0 * np.pi * frequency_hz * np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    )


def motion(command: F64, judged: int = 0) -> Motion:
    """Return the motion of a command of 6 at most that a displacement follows by 3 um a unit."""
    step_s, counts = np.full(command.size, 1.0 / RATE_HZ), np.arange(command.size) >= judged
    return Motion.of((command, 3.0 * command), step_s, counts, 6.0, 36.0)


def counts(command: F64, most: int, cuts: list[int]) -> tuple[list[int], list[float]]:
    """Return how many rows there are in each part of a command, and their weight."""
    rows = chosen([motion(command)], most)
    parts = np.searchsorted(rows.samples[0], cuts)
    weights = np.split(rows.scale**2, parts)
    return [part.size for part in weights], [float(part.sum()) for part in weights]


def test_small_loops_weigh_more_than_large_ones():
    both = np.concatenate((sine(6.0, 20.0, 1.0), sine(2.0, 20.0, 1.0)))
    (large, small), (one, other) = counts(both, 2000, [10_000])
    assert large == pytest.approx(small, rel=0.05)
    assert other / one == pytest.approx(3.0**SMALL, rel=0.1)


def test_no_swing_weighs_more_than_the_smallest_that_counts():
    tiny = [sine(part * LEAST_SWING * 6.0, 20.0, 1.0) for part in (0.9, 0.3)]
    _, (_, one, other) = counts(
        np.concatenate((sine(6.0, 20.0, 1.0), *tiny)), 3000, [10_000, 20_000]
    )
    assert other < 1.1 * one


def test_a_fast_loop_does_not_weigh_by_its_cycles_nor_a_slow_one_by_its_time():
    both = np.concatenate((sine(6.0, 100.0, 1.0), sine(6.0, 1.0, 2.0)))
    _, (fast, slow) = counts(both, 2000, [10_000])
    assert 0.4 < slow / fast < 2.5


def test_a_rest_has_neither_rows_nor_weight():
    still = np.concatenate((sine(6.0, 20.0, 1.0), np.zeros(100_000)))
    assert counts(still, 1000, [10_000])[0] == [1000 - 1, 0]


@pytest.mark.parametrize("judged", [0, 50, 4001])
def test_rows_are_samples_that_count(judged):
    rows = chosen([motion(sine(6.0, 20.0, 1.0), judged), motion(sine(1.0, 10.0, 1.0))], 500)
    first, second = rows.samples
    assert first.min() >= judged
    assert (np.diff(first) > 0).all()
    assert (np.diff(second) > 0).all()
    assert first.size + second.size == rows.scale.size <= 500
    assert np.mean(rows.scale**2) == pytest.approx(1.0)


def test_more_rows_are_no_more_weight_for_any_of_them():
    command = np.concatenate((sine(6.0, 20.0, 1.0), sine(1.0, 5.0, 1.0)))
    few, more = counts(command, 400, [10_000])[1], counts(command, 4000, [10_000])[1]
    assert np.divide(few, sum(few)) == pytest.approx(np.divide(more, sum(more)), abs=0.03)


def test_a_thinned_motion_is_the_same_way_and_time():
    whole = motion(sine(6.0, 20.0, 1.0), judged=101)
    kept = np.arange(0, 10_000, 7)
    few = whole.at(kept)
    assert few.travel.sum() == pytest.approx(whole.travel[: kept[-1] + 1].sum())
    assert few.step_s.sum() == pytest.approx(whole.step_s[: kept[-1] + 1].sum())
    assert few.swing.tolist() == whole.swing[kept].tolist()
    assert few.judged.tolist() == (kept >= 101).tolist()
