"""Compute the spectrum of the error of an active run."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.desk.signals import ROW, Traces

_SAMPLES = 16384
_POINTS = 240


class ErrorSpectrum:
    """Amplitude spectrum of the newest samples of the error.

    Args:
        sample_rate_hz: Samples per second.
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self._rate_hz = sample_rate_hz
        self._newest = np.empty(0)

    def add(self, traces: Traces) -> None:
        """Add the next samples; a gap or a sample without error starts a new spectrum."""
        error_um = traces.values[ROW["error"]]
        broken = ~np.isfinite(error_um)
        if broken.any():
            last = int(np.flatnonzero(broken)[-1])
            self._newest, error_um = np.empty(0), error_um[last + 1 :]
        self._newest = np.concatenate((self._newest, error_um))[-_SAMPLES:]

    def points(self) -> tuple[F64, F64]:
        """Return frequencies in Hz and amplitudes in um, each the maximum of its neighbours.

        Both float64[k]; empty before there are 256 samples. A sine of 1 um has a line of 1 um.
        """
        size = 1 << (self._newest.size.bit_length() - 1) if self._newest.size else 0
        if size < 256:
            return np.empty(0), np.empty(0)
        window = np.hanning(size)
        error_um = self._newest[-size:]
        lines_um = np.abs(np.fft.rfft((error_um - error_um.mean()) * window))
        lines_um *= 2.0 / window.sum()
        # Use the maximum, so that a line does not vanish between its neighbours.
        edges = np.unique(np.geomspace(1, lines_um.size, _POINTS).astype(np.int64))[:-1]
        largest_um: F64 = np.maximum.reduceat(lines_um, edges)
        return edges.astype(np.float64) * np.float64(self._rate_hz / size), largest_um
