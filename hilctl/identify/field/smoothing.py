"""A displacement and its derivatives, smoothed by more where it moves slowly.

What is narrow enough for the fastest loop leaves most of a sensor's noise. In small and slow loops
it turns the path back and forth where the actuator went one way, and a model is bent by that.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

from hilctl.base.arrays import F64
from hilctl.models.chain import smoothing_weights

WIDER = 4.0  # of the first width: the second
MEDIAN_SQUARE = 0.4549  # of numbers whose mean square is 1, with Gauss's distribution
LEAST = 0.01  # part of the noise that a smoothing has to take away to say how much there is


def smoothed(displacement_um: F64, width: float, rate_hz: float) -> F64:
    """Return the displacement and its first two derivatives by time: float64[3, n].

    Of what a wider smoothing takes away more, that part is kept by which it is more than noise (J.
    S. Lee, IEEE Trans. Pattern Anal. Mach. Intell. 2 (1980) 165). How much noise would be is known
    from what the first smoothing takes away.

    Args:
        displacement_um: float64[n].
        width: Of the first smoothing, in samples.
        rate_hz: Samples a second.
    """
    plain, wide = smoothing_weights(width)[0], smoothing_weights(WIDER * width)[0]
    found = _derivatives(displacement_um, width, rate_hz)
    own = 1.0 - 2.0 * plain[plain.size // 2] + float(np.sum(plain**2))
    if own < LEAST or wide.size > displacement_um.size:
        return np.ascontiguousarray(found)
    noise = float(np.median((displacement_um - found[0]) ** 2)) / (MEDIAN_SQUARE * own)
    calm = _derivatives(displacement_um, WIDER * width, rate_hz)
    apart = wide.copy()
    apart[(wide.size - plain.size) // 2 :][: plain.size] -= plain
    off = uniform_filter1d((found[0] - calm[0]) ** 2, 2 * wide.size, mode="nearest")
    kept = 1.0 - noise * float(np.sum(apart**2)) / np.maximum(off, np.finfo(np.float64).tiny)
    return np.ascontiguousarray(calm + np.maximum(kept, 0.0) * (found - calm))


def _derivatives(y: F64, width: float, rate_hz: float) -> F64:
    plain = smoothing_weights(width)[0]
    by_slope = smoothing_weights(width, slope_gain=rate_hz)[0] - plain
    by_bend = smoothing_weights(width, bend_gain=rate_hz**2)[0] - plain
    return np.stack([_convolved(y, weights) for weights in (plain, by_slope, by_bend)])


def _convolved(y: F64, weights: F64) -> F64:
    """Return y under odd weights of which the middle one is its own, its ends going on as are."""
    padded = np.pad(y, weights.size // 2, mode="edge")
    return np.convolve(padded, weights[::-1], "valid")
