"""Spectrum of the error of a steady stretch, and its harmonics: pure functions of arrays."""

from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64, I64
from hilctl.base.metrics import fold
from hilctl.base.segments import Segment
from hilctl.recording.data import Recording

MOST_HARMONICS = 20
_MOST_SAMPLES = 2**20
_LARGEST_UM = 1e100  # readings near the end of all numbers have no spectrum
_WIDEST_GAP = 0.02  # of the samples that may be missing


@dataclass(frozen=True, slots=True)
class ErrorSpectrum:
    """Spectrum of the error over steady samples.

    Attributes:
        frequency_hz: float64[k], > 0.
        amplitude_um: float64[k], amplitude of a sine there, Hann window.
        harmonics_um: float64[h], amplitude at 1, 2, ... times the waveform's frequency; empty
            where nothing repeats.
        constant_um: Mean error.
    """

    frequency_hz: F64
    amplitude_um: F64
    harmonics_um: F64
    constant_um: float


def error_spectrum(recording: Recording, segment: Segment, index: I64, error_um: F64
                   ) -> ErrorSpectrum | None:  # fmt: skip
    """Return the spectrum of an error; None where too little of it is finite.

    Args:
        recording: The run.
        segment: The segment that the samples are of.
        index: int64[n], sample indexes, rising.
        error_um: float64[n].
    """
    finite = np.isfinite(error_um)
    if np.count_nonzero(finite) < 2 * MOST_HARMONICS:
        return None
    index, error_um = index[finite][-_MOST_SAMPLES:], error_um[finite][-_MOST_SAMPLES:]
    span = int(index[-1] - index[0]) + 1
    if span - index.size > _WIDEST_GAP * span or np.abs(error_um).max() > _LARGEST_UM:
        return None
    even = np.interp(np.arange(index[0], index[-1] + 1), index, error_um)
    window = np.hanning(span + 1)[:-1]
    mean_um = float(even.mean())
    wave = np.fft.rfft((even - mean_um) * window)
    size = np.asarray(np.abs(wave), dtype=np.float64) * (2.0 / float(window.sum()))
    frequency_hz: F64 = np.arange(float(size.size)) * (recording.sample_rate_hz / span)
    harmonics_um = _harmonics(index - segment.start, error_um, segment.period)
    return ErrorSpectrum(frequency_hz[1:], size[1:], harmonics_um, mean_um)


def _harmonics(index: I64, error_um: F64, period: float) -> F64:
    """Return the amplitudes of the average cycle's harmonics; noise is averaged away in it."""
    if period <= 2.0 * MOST_HARMONICS:
        return np.empty(0)
    cycle = fold(index, period, [error_um])
    if not cycle.whole:
        return np.empty(0)
    turns = np.arange(1, MOST_HARMONICS + 1)[:, None] * cycle.phase
    waves = np.exp(-2j * np.pi * turns)
    steps = 0.5 * ((np.roll(cycle.phase, -1) - np.roll(cycle.phase, 1)) % 1.0)  # of uneven bins
    found: F64 = 2.0 * np.abs(waves @ (cycle.signals[0] * steps))
    return found


def thinned(spectrum: ErrorSpectrum, points: int) -> tuple[F64, F64]:
    """Return frequency and the largest amplitude of stretches even in the logarithm of frequency.

    Args:
        spectrum: The spectrum.
        points: Most stretches.
    """
    x, y = spectrum.frequency_hz, spectrum.amplitude_um
    if x.size <= points:
        return x, y
    edges = np.unique(np.searchsorted(x, np.geomspace(x[0], x[-1], points)))
    middle = x[np.minimum((edges + np.append(edges[1:], x.size)) // 2, x.size - 1)]
    return middle, np.maximum.reduceat(y, edges)
