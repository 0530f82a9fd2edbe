"""Nearest points of a path."""

import math

from hilctl.base.types import F64, F64_2D, I64
from hilctl.kernels.jit import kernel


@kernel(nogil=True)
def nearest_on_path(
    path: F64_2D, arc: F64, points: F64_2D, rows: I64, reach: int, distance: F64, position: F64
) -> int:
    """Find the nearest point of a path to each point, at most ``reach`` rows from its own.

    The path is float64[n, d], n >= 2, joined by straight lines; ``arc`` float64[n] is its length up
    to each row. The points are float64[m, d], finite, and ``rows`` int64[m] are theirs in the path.
    Set ``distance`` and ``position``, float64[m]: the row of the nearest point, in general between
    two rows. Of points as near, it is one close to that of the point before.

    A stretch of the path is skipped if it is too short to lead from its start to a nearer point.

    Return the number of points whose nearest one is at an end of their stretch within the path.
    """
    limited = offset = 0
    for k in range(rows.size):
        low, high = max(rows[k] - reach, 0), min(rows[k] + reach, path.shape[0] - 1)
        best, place = math.inf, float(rows[k])
        j = min(max(rows[k] + offset, low), high - 1)
        started = False
        while j < high:
            along = length = 0.0
            for d in range(path.shape[1]):
                step = path[j + 1, d] - path[j, d]
                along += step * (points[k, d] - path[j, d])
                length += step * step
            share = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
            square = end_square = 0.0
            for d in range(path.shape[1]):
                step = path[j + 1, d] - path[j, d]
                square += (points[k, d] - path[j, d] - share * step) ** 2
                end_square += (points[k, d] - path[j + 1, d]) ** 2
            gap = math.sqrt(square)
            if gap < best:
                best, place = gap, j + share
            if not started:
                started, j = True, low
                continue
            reached = arc[j + 1] + max(math.sqrt(end_square) - best, 0.0)
            j, stop = j + 1, high + 1
            while stop - j > 1:  # the last row within that length
                middle = (j + stop) // 2
                if arc[middle] <= reached:
                    j = middle
                else:
                    stop = middle
        distance[k], position[k] = best, place
        offset = int(place) - rows[k]
        if (place <= low and low > 0) or (place >= high and high < path.shape[0] - 1):
            limited += 1
    return limited
