"""The nearest points of a path against all segments of it, and against closed forms."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.types import F64, I64
from hilctl.kernels.path import nearest_on_path


def nearest(path: F64, points: F64, rows: I64, reach: int) -> tuple[F64, F64, int]:
    """Return distances, positions, and the number of points at an end of their stretch."""
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    distance, position = np.empty(rows.size), np.empty(rows.size)
    limited = nearest_on_path(path, arc, points, rows, reach, distance, position)
    return distance, position, limited


def by_all_segments(path: F64, point: F64, row: int, reach: int) -> float:
    low, high = max(row - reach, 0), min(row + reach, len(path) - 1)
    start, step = path[low:high], np.diff(path[low : high + 1], axis=0)
    length = np.sum(step**2, axis=1)
    share = np.sum(step * (point - start), axis=1) / np.where(length > 0.0, length, 1.0)
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * step
    return float(np.linalg.norm(point - foot, axis=1).min())


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
    distance, position, _ = nearest(path, points[rows], rows, reach)
    expected = [by_all_segments(path, points[row], row, reach) for row in rows]
    np.testing.assert_allclose(distance, expected, rtol=1e-9, atol=1e-9)
    feet = np.linalg.norm(points[rows] - at(path, position), axis=1)
    np.testing.assert_allclose(feet, distance, rtol=0.0, atol=1e-9)
    assert np.all(np.abs(position - rows) <= reach)


def test_rest_keeps_the_branch_of_the_point_before():
    """On a line there and back, a lagging point stays on its way, although both are as near."""
    x = np.concatenate([np.arange(0.0, 100.0), np.arange(100.0, -1.0, -1.0)])
    path = np.column_stack([x, np.zeros_like(x)])
    rows = np.arange(20, 180)
    distance, position, limited = nearest(path, path[rows - 10], rows, 50)
    np.testing.assert_array_equal(distance, 0.0)
    np.testing.assert_allclose(position, rows - 10.0)
    assert limited == 0


def test_lag_beyond_the_stretch_is_counted():
    path = np.column_stack([np.arange(100.0), np.zeros(100)])
    rows = np.arange(40, 60)
    distance, position, limited = nearest(path, path[rows - 10], rows, 8)
    np.testing.assert_allclose(distance, 2.0)
    np.testing.assert_array_equal(position, rows - 8.0)
    assert limited == rows.size
