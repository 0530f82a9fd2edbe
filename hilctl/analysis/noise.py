"""Sensor noise, and the floor it puts under the peak hysteresis: pure functions of arrays."""

import math

import numpy as np
from scipy.special import erf

from hilctl.base.arrays import F64, I64

SHORTEST_PERIOD = 16.0
"""Shortest period, in samples, at which the signal still passes for smooth beside the noise."""

_ORDER = 6
_GAIN = 924.0**0.5  # of white noise: the root of binomial(12, 6)
_MAD_TO_SIGMA = 1.482602218505602
_FEWEST_WINDOWS = 32


def sensor_noise_um(index: I64, displacement_um: F64) -> float | None:
    """Estimate the rms of white noise that rides on a smooth displacement.

    What seven neighbouring samples have that no polynomial of degree 5 explains (their sixth
    difference, scaled to pass white noise with gain 1) is noise: of an 83 um sine at 250 Hz and
    50 kHz it leaves 1 pm. Its spread is taken from the median magnitude, so that spikes, steps and
    the corners of a triangle don't count. Noise that the sensor itself has low-passed is read too
    low: by 13 % at a bandwidth of 0.3 times the sample rate.

    Args:
        index: int64[n], sample index; windows with a gap are left out.
        displacement_um: float64[n]; values that are not finite count as gaps.

    Returns:
        rms in um; None with fewer than 32 windows.
    """
    finite = np.isfinite(displacement_um)
    index, displacement_um = index[finite], displacement_um[finite]
    if index.size < _ORDER + _FEWEST_WINDOWS:
        return None
    unbroken = index[_ORDER:] - index[:-_ORDER] == _ORDER
    windows = np.diff(displacement_um, _ORDER)[unbroken]
    if windows.size < _FEWEST_WINDOWS:
        return None
    return _MAD_TO_SIGMA * float(np.median(np.abs(windows))) / _GAIN


def expected_maximum(values: int) -> float:
    """Return the expected largest magnitude of that many independent standard normal values."""
    x = np.linspace(0.0, 10.0, 2001)
    below = erf(x / np.sqrt(2.0)) ** values
    return float(np.trapezoid(1.0 - below, x))


def noise_floor_percent(noise_um: float, counts: I64, peak_to_peak_um: float) -> float | None:
    """Return the peak hysteresis that noise alone makes of a loop without any.

    An average cycle of m bins has m/2 pairs of a rising and a falling bin; the difference of each
    pair has the noise of two bin means. The figure is the expected largest of them. Loops with
    several branches have more pairs and a floor up to about a fifth higher.

    Args:
        noise_um: rms of a single sample, in um.
        counts: int64[m], samples in each bin of the average cycle.
        peak_to_peak_um: Peak-to-peak of its output.

    Returns:
        Floor in percent of the peak-to-peak; None where that is 0 or there is no bin.
    """
    if counts.size == 0 or peak_to_peak_um <= 0.0:
        return None
    bin_noise_um = noise_um * math.sqrt(float(np.mean(1.0 / counts)))
    largest_um = expected_maximum(max(1, counts.size // 2)) * math.sqrt(2.0) * bin_noise_um
    return 100.0 * largest_um / peak_to_peak_um
