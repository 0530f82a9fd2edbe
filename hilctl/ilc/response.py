"""Response of the displacement to a change of the correction, identified from the runs.

With a nearly exact compensator the response is close to a delay of some samples. The remaining
resonance of the structure limits the bandwidth of a correction. The response is therefore a gain, a
delay and one second-order resonance, fitted to the changes of each harmonic.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.types import C128, F64

_COUPLING = 0.15
"""Share of a harmonic's change that hysteresis couples into its neighbours."""

_CLEAR = 4.0
_FIRST_DOUBT = 0.05

# Parameters: log gain, delay in samples, (highest / natural frequency)^2, log damping ratio.
_BELIEVED = np.array([0.0, 1.0, 0.0, math.log(0.2)])
_DOUBT = np.array([0.2, 10.0, 0.7, 0.7])
_LOW = np.array([-2.0, -50.0, 0.0, math.log(0.02)])
_HIGH = np.array([2.0, 200.0, 25.0, math.log(2.0)])


@dataclass(frozen=True, slots=True)
class Response:
    """``gain exp(-i w delay) / (1 - (w/w_n)^2 + 2 i zeta w/w_n)``.

    Attributes:
        gain: At frequency 0.
        delay_s: Delay; negative if the compensator leads too far.
        inverse_natural_s2: 1 / w_n^2, in s^2; 0 without a resonance.
        damping_ratio: zeta.
    """

    gain: float = 1.0
    delay_s: float = 0.0
    inverse_natural_s2: float = 0.0
    damping_ratio: float = 0.2

    def at(self, frequency_hz: F64) -> C128:
        """Return the response at frequencies in Hz: complex128[n]."""
        s = 2j * np.pi * frequency_hz
        slow = self.inverse_natural_s2
        resonance = 1.0 + 2.0 * self.damping_ratio * np.sqrt(slow) * s + slow * s**2
        answer: C128 = self.gain * np.exp(-s * self.delay_s) / resonance
        return answer

    @property
    def natural_hz(self) -> float | None:
        """Natural frequency; None without a resonance."""
        if self.inverse_natural_s2 <= 0.0:
            return None
        return float(1.0 / (2.0 * np.pi * np.sqrt(self.inverse_natural_s2)))


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a correction, complex128[K + 1], its effect on the error, and its noise."""

    step_hz: float
    correction_um: C128
    error_um: C128
    noise_um: F64

    def points(self) -> tuple[F64, C128, F64]:
        """Return frequencies, measured responses and weights of significant changes."""
        size = np.abs(self.correction_um)
        near = np.array([0.25, 0.5, 1.0, 0.0, 1.0, 0.5, 0.25])
        spread = np.sqrt(np.convolve(size**2, near)[3 : size.size + 3])
        doubt = self.noise_um + _COUPLING * spread
        clear = (size > _CLEAR * self.noise_um) & (size > doubt)
        clear[0] = False
        k = np.flatnonzero(clear)
        weight = size[k] / np.hypot(doubt[k], _COUPLING * size[k])
        return k.astype(np.float64) * self.step_hz, self.error_um[k] / self.correction_um[k], weight


def fit(changes: Sequence[Change], first: tuple[float, complex], sample_rate_hz: float) -> Response:
    """Fit the response to all changes.

    Before the first change, the response to the reference gives an estimate of delay and resonance,
    beyond the error of the remaining hysteresis: ``first`` holds the frequency of the reference's
    strongest harmonic, and displacement over reference.
    """
    parts = [change.points() for change in changes]
    frequency = np.concatenate([[first[0]], *(part[0] for part in parts)])
    measured = np.concatenate([[first[1]], *(part[1] for part in parts)])
    weight = np.concatenate([[1.0 / _FIRST_DOUBT], *(part[2] for part in parts)])
    highest = float(frequency.max())

    def residuals(x: F64) -> F64:
        off = weight * (_response(x, highest, sample_rate_hz).at(frequency) - measured)
        return np.concatenate((off.real, off.imag, (x - _BELIEVED) / _DOUBT))

    late = -math.atan2(first[1].imag, first[1].real) / (2.0 * math.pi * first[0])
    delays = (1.0, min(max(late * sample_rate_hz, 0.9 * _LOW[1]), 0.9 * _HIGH[1]))
    tries = [
        least_squares(
            residuals, [0.0, delay, slow, _BELIEVED[3]], bounds=(_LOW, _HIGH), loss="soft_l1"
        )
        for delay in delays
        for slow in (0.05, 0.7, 2.0)
    ]
    return _response(min(tries, key=lambda each: float(each.cost)).x, highest, sample_rate_hz)


def _response(x: F64, highest_hz: float, sample_rate_hz: float) -> Response:
    slow = float(x[2]) / (2.0 * np.pi * highest_hz) ** 2
    return Response(float(np.exp(x[0])), float(x[1]) / sample_rate_hz, slow, float(np.exp(x[3])))
