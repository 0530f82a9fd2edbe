"""Nearest points of a path."""

import math

import numpy as np

from hilctl.base.types import F64, F64_2D, I64
from hilctl.kernels.jit import kernel


@kernel(inline=True, nogil=True)
def _distance(points: F64_2D, k: int, path: F64_2D, row: int) -> float:
    """Return the distance of a point from a row of a path."""
    square = 0.0
    for d in range(path.shape[1]):
        square += (points[k, d] - path[row, d]) ** 2
    return math.sqrt(square)


@kernel(nogil=True)
def nearest_on_path(
    path: F64_2D, arc: F64, points: F64_2D, rows: I64, reach: int, distance: F64, position: F64
) -> None:
    """Find the nearest point of a path to each point, on the stretch around the point's row.

    The path is float64[n, d], n >= 2, joined by straight lines; ``arc`` float64[n] is its length up
    to each row. The points are float64[m, d], finite, and ``rows`` int64[m] are theirs in the path.
    The stretch of a point extends, before and after its row, by at least twice its distance from
    that row, and by ``reach`` rows at most. Set ``distance`` and ``position``, float64[m]: the row
    of the nearest point, in general between two rows.

    Rows are skipped if the path is too short there to lead to a nearer point.
    """
    offset = 0
    for k in range(rows.size):
        row = rows[k]
        best, place = _distance(points, k, path, row), float(row)
        first, last = max(row - reach, 0), min(row + reach, path.shape[0] - 1)
        start, end = arc[row] - 2.0 * best, arc[row] + 2.0 * best
        # The nearer the first guess, the more can be skipped.
        guess = min(max(row + offset, first), last)
        gap = _distance(points, k, path, guess)
        if gap < best and start <= arc[guess] <= end:
            best, place = gap, float(guess)
        j = first + max(np.searchsorted(arc[first : row + 1], start, side="right") - 1, 0)
        while j < last and arc[j] < end:
            along = length = square = 0.0
            for d in range(path.shape[1]):
                step = path[j + 1, d] - path[j, d]
                along += step * (points[k, d] - path[j, d])
                length += step * step
            share = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
            for d in range(path.shape[1]):
                step = path[j + 1, d] - path[j, d]
                square += (points[k, d] - path[j, d] - share * step) ** 2
            if math.sqrt(square) < best:
                best, place = math.sqrt(square), j + share
            reached = arc[j + 1] + max(_distance(points, k, path, j + 1) - best, 0.0)
            j += np.searchsorted(arc[j + 1 : last + 1], reached, side="right")
        distance[k], position[k] = best, place
        offset = int(place) - row
