"""Long signals reduced to what a plot can show, without hiding spikes or inventing beats."""

import numpy as np

from hilctl.base.arrays import F64, I64

MAX_POINTS = 4000
"""Most points of one line."""

_NARROWEST_CYCLE = 1.0 / 150.0
_MAX_BUCKETS = 600


def min_max(t: F64, values: F64, points: int = MAX_POINTS) -> tuple[F64, F64]:
    """Reduce a signal to the lowest and highest value of each of even stretches.

    Every spike stays. Values that are not finite are left out; where a stretch has no other, the
    line is broken by NaN.

    Args:
        t: float64[n].
        values: float64[n].
        points: Most points to return, >= 2.

    Returns:
        t and values, float64[m] each, m <= max(points, 2).
    """
    if values.size <= points:
        return t, values
    edges = _edges(values.size, max(1, points // 2))
    low, high = _extremes(values, edges)
    middle = t[(edges + np.append(edges[1:], values.size)) // 2]
    return np.repeat(middle, 2), np.column_stack((low, high)).ravel()


def band(index: I64, values: F64, period: float) -> tuple[F64, F64, F64]:
    """Reduce a periodic signal to the band it fills, on stretches of at least one period.

    Shorter stretches would beat with the period and draw waves that are not there.

    Args:
        index: int64[n], n > 0, sample index, rising.
        values: float64[n].
        period: Samples in one period, > 0.

    Returns:
        Sample index of each stretch's middle, lowest and highest value in it: float64[m] each.
    """
    span = int(index[-1] - index[0]) + 1
    stretches = max(1, min(_MAX_BUCKETS, int(span / period)))
    of = (index - index[0]) * stretches // span
    edges = np.flatnonzero(np.diff(of, prepend=-1))
    low, high = _extremes(values, edges)
    middle = index[0] + (of[edges] + 0.5) * span / stretches
    return middle, low, high


def shown_as_band(samples: int, period: float, shown: int) -> bool:
    """Return whether cycles would be too narrow for a line.

    Args:
        samples: Length of the stretch with this period.
        period: Samples in one period; 0.0 where it does not repeat.
        shown: Samples on the whole time axis.
    """
    return 0.0 < period < shown * _NARROWEST_CYCLE and samples > 4.0 * period


def _edges(size: int, stretches: int) -> I64:
    return np.arange(stretches, dtype=np.int64) * size // stretches


def _extremes(values: F64, edges: I64) -> tuple[F64, F64]:
    finite = np.where(np.isfinite(values), values, np.nan)
    return np.fmin.reduceat(finite, edges), np.fmax.reduceat(finite, edges)
