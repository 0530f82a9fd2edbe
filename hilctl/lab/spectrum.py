"""Harmonics of periodic signals, spectra, and Allan deviation: pure functions of arrays.

Sources: J. S. Bendat, A. G. Piersol, Random Data (2010), for averaged spectra; W. J. Riley,
Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), for the overlapping Allan deviation.
"""

import numpy as np

from hilctl.base.types import C128, F64, I64
from hilctl.signals.cycle_metrics import fold

_BINS = 8192
_SHORTEST = 8  # samples of a part, for a few lines
_AVERAGES = 8  # segments of an averaged spectrum that fit side by side
_TIMES = 60
_FEWEST_MEANS = 4  # means that fit side by side at the longest averaging time


def coefficients(index: I64, period: float, values: F64, count: int) -> C128:
    """Return Fourier coefficients of whole cycles of a signal: complex128[count + 1].

    A cosine of amplitude 1 has c_k = 0.5. Phase 0 is at multiples of ``period``; values that are
    not finite are omitted.
    """
    folded = fold(index, period, (values,), _BINS)
    phase = folded.phase
    around = np.concatenate(([phase[-1] - 1.0], phase, [phase[0] + 1.0]))
    weighted = folded.signals[0] * (around[2:] - around[:-2]) * 0.5
    turns = np.exp(-2j * np.pi * phase)
    rotated = np.ones_like(turns)
    found = np.empty(count + 1, dtype=np.complex128)
    for k in range(count + 1):
        found[k] = np.dot(weighted, rotated)
        rotated *= turns
    return found


def each_cycle(since: I64, period: float, values: F64, cycles: int, count: int = 2) -> C128:
    """Return the coefficients of each whole cycle without drift: complex128[cycles, count + 1].

    ``since`` is the sample number since the start of the segment.
    """
    good = np.isfinite(values)
    since, values = since[good], values[good]
    number = np.floor((since - since[-1] - 0.5) / period).astype(np.int64) + cycles
    rows = [row for k in range(cycles) if (row := number == k).any()]
    if len(rows) > 1:  # a line through the samples would remove part of the sine
        means = [float(values[row].mean()) for row in rows]
        slope = np.polynomial.polynomial.polyfit(np.arange(len(rows)), means, 1)[1]
        values = values - slope * since / period
    return np.array([coefficients(since[r], period, values[r], count) for r in rows])


def amplitude_spectrum(values: F64, sample_rate_hz: float) -> tuple[F64, F64]:
    """Return frequencies, > 0, and the amplitude of a sine there, Hann window: float64[k] each."""
    from scipy import signal  # it imports scipy.stats, which is slow

    hz, power = signal.periodogram(values, sample_rate_hz, "hann", scaling="spectrum")
    return hz[1:], np.sqrt(2.0 * power[1:])


def density(values: F64, sample_rate_hz: float, shortest: int = 0) -> tuple[F64, F64, float]:
    """Return frequencies, the amplitude density per root Hz, float64[k] each, and its median.

    Averaged spectra of overlapping parts without their linear trend (Welch, Hann windows), of at
    least ``shortest`` samples each. The median is scaled to the mean power of white noise.
    """
    from scipy import signal  # it imports scipy.stats, which is slow

    size = min(values.size, max(values.size // _AVERAGES, shortest, _SHORTEST))
    hz, power = signal.welch(values, sample_rate_hz, nperseg=size, detrend=signal.detrend)
    averages = 2 * values.size // size - 1
    scale = (1.0 - 1.0 / (9.0 * averages)) ** 3  # median over mean of averaged powers
    hz, power = hz[1:-1], power[1:-1]  # the ends have another scale
    return hz, np.sqrt(power), float(np.sqrt(np.median(power) / scale))


def allan_deviation(values: F64, sample_rate_hz: float) -> tuple[F64, F64]:
    """Return averaging times in s, and the overlapping Allan deviation of means over each.

    Up to 60 times, to a quarter of the signal: float64[m] each, empty with fewer than 4 values.
    """
    total = np.concatenate(([0.0], np.cumsum(values - values.mean())))
    longest = values.size // _FEWEST_MEANS
    counts = np.unique(np.geomspace(1, longest, _TIMES).astype(np.int64)) if longest else ()
    found = [
        np.sqrt(0.5 * np.mean(np.square(total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m]))) / m
        for m in counts
    ]
    return np.array(counts) / sample_rate_hz, np.array(found)


def in_bands(hz: F64, size: F64, bands: int) -> tuple[F64, F64, F64]:
    """Reduce a spectrum to bands of equal ratio: frequency, rms and largest, float64[m] each."""
    if hz.size <= bands:
        return hz, size, size
    edges = np.unique(np.searchsorted(hz, np.geomspace(hz[0], hz[-1], bands)))
    stops = np.append(edges[1:], hz.size)
    middle = hz[np.minimum((edges + stops) // 2, hz.size - 1)]
    rms = np.sqrt(np.add.reduceat(np.square(size), edges) / (stops - edges))
    return middle, rms, np.maximum.reduceat(size, edges)
