"""Weights that smooth a wanted displacement, and undo a structure, without a shift in time."""

import math

import numpy as np

from hilctl.base.arrays import F64

_WIDEST = 64


def smoothing_weights(
    width: float, slope_gain: float = 0.0, bend_gain: float = 0.0
) -> tuple[F64, int]:
    """Return weights for y + slope_gain y' + bend_gain y'' of a smoothed y, per sample.

    A cubic B-spline smooths, four boxes one after another, and minus half its variance times y''
    makes its response flat: 1 - (w s)^4 / 8 at an angular frequency w, for a standard deviation s.
    So slow signals pass as they are, and corners are rounded within about 2 s.

    Args:
        width: Standard deviation s in samples; 0 for plain central differences.
        slope_gain: In samples.
        bend_gain: In samples squared.

    Returns:
        float64[2m + 1], weights of the samples from the oldest to the newest, which add up to 1;
        and m, the samples by which the newest is ahead. Boxes are at most 64 samples long.
    """
    box = min(_WIDEST, max(1, round(math.sqrt(1.0 + 3.0 * width**2))))
    ones = np.full(box, 1.0 / box)
    pair = np.convolve(ones, ones)
    spline = np.convolve(pair, pair)
    variance = (box**2 - 1) / 3.0
    weights = np.pad(spline, 1)
    weights += slope_gain * np.convolve(spline, (-0.5, 0.0, 0.5))
    weights += (bend_gain - 0.5 * variance) * np.convolve(spline, (1.0, -2.0, 1.0))
    return weights, 2 * box - 1
