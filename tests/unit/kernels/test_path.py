"""The nearest points of a path against all segments of it, and against closed forms."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.types import F64, I64
from hilctl.kernels.path import nearest_on_path


def nearest(path: F64, points: F64, rows: I64, reach: int) -> tuple[F64, F64]:
    """Return distances and positions."""
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    distance, position = np.empty(rows.size), np.empty(rows.size)
    nearest_on_path(path, arc, points, rows, reach, distance, position)
    return distance, position


def by_all_segments(path: F64, point: F64, row: int, reach: int) -> tuple[float, float]:
    """Return the distance from the least stretch of the path, and from the one a row longer."""
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    away = float(np.linalg.norm(point - path[row]))
    near = np.flatnonzero(np.abs(length - length[row]) < 2.0 * away)
    found = []
    for beside in (0, 1):
        low = max(row - reach, min([row, *near]) - beside, 0)
        high = min(row + reach, max([row, *near]) + beside, len(path) - 1)
        start, step = path[low:high], np.diff(path[low : high + 1], axis=0)
        squares = np.sum(step**2, axis=1)
        share = np.sum(step * (point - start), axis=1) / np.where(squares > 0.0, squares, 1.0)
        foot = start + np.clip(share, 0.0, 1.0)[:, None] * step
        found.append(min([away, *np.linalg.norm(point - foot, axis=1)]))
    return found[0], found[1]


def at(path: F64, position: F64) -> F64:
    columns = [np.interp(position, np.arange(len(path)), column) for column in path.T]
    return np.column_stack(columns)


@given(st.integers(0, 2**32), st.integers(2, 60), st.integers(1, 70), st.integers(1, 3),
       st.sampled_from(["smooth", "random", "grid"]))  # fmt: skip
@settings(deadline=None)
def test_distance_is_that_of_all_segments(seed, size, reach, dimensions, kind):
    """Also of paths with rests, reversals and repeated points."""
    rng = np.random.default_rng(seed)
    path = rng.normal(size=(size, dimensions))
    if kind == "smooth":
        path = np.cumsum(path, axis=0)
    if kind == "grid":
        path = np.round(path)
    points = path + rng.choice([0.0, 1e-6, 0.1, 3.0]) * rng.normal(size=path.shape)
    points = np.ascontiguousarray(points)
    rows = np.flatnonzero(rng.random(size) < 0.7)
    distance, position = nearest(path, points[rows], rows, reach)
    expected = [by_all_segments(path, points[row], row, reach) for row in rows]
    for found, (least, longer) in zip(distance, expected, strict=True):
        assert longer - 1e-9 <= found <= least + 1e-9
    feet = np.linalg.norm(points[rows] - at(path, position), axis=1)
    np.testing.assert_allclose(feet, distance, rtol=0.0, atol=1e-9)
    assert np.all(np.abs(position - rows) <= reach)


def test_long_stretch_is_that_of_all_segments():
    """Far points have the whole path as their stretch."""
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.normal(size=(500, 2)), axis=0)
    points = path + 1e4
    distance, _ = nearest(path, points, np.arange(500), 500)
    expected = [by_all_segments(path, points[row], row, 500)[0] for row in range(500)]
    np.testing.assert_allclose(distance, expected, rtol=1e-12)


def test_another_branch_is_not_taken():
    """Back beside a line, 0.5 away: a point 0.3 towards the way back stays on its own."""
    x = np.concatenate([np.arange(100.0), np.arange(99.0, -1.0, -1.0)])
    path = np.column_stack([x, np.repeat([0.0, 0.5], 100)])
    rows = np.arange(10, 90)
    distance, position = nearest(path, path[rows] + [0.0, 0.3], rows, 200)
    np.testing.assert_allclose(distance, 0.3)
    np.testing.assert_array_equal(position, rows)


def test_lag_beyond_the_reach():
    path = np.column_stack([np.arange(100.0), np.zeros(100)])
    rows = np.arange(40, 60)
    distance, position = nearest(path, path[rows - 10], rows, 8)
    np.testing.assert_allclose(distance, 2.0)
    np.testing.assert_array_equal(position, rows - 8.0)
