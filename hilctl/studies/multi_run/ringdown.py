"""Natural frequency and damping from the ringing after a step.

A decaying sine, for the mechanical structure, and a decaying exponential, for creep, are fitted
together to the displacement after the step.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.types import F64

_CYCLES = 8.0  # of the ringing, in the fit
_FEWEST = 40  # samples
_SEEN = 5.0  # least amplitude of the ringing over the misfit
_MOST_DAMPING = 0.9
_LOWEST_CYCLES = 4.0  # in the signal
_HIGHEST = 0.1  # of the sample rate
_FREQUENCIES = 40
_REFINED = 3
_DAMPINGS = (0.05, 0.15, 0.4)
_RATES = (0.1, 0.5, 2.0)  # of the creep, over the angular frequency


@dataclass(frozen=True, slots=True)
class Ringing:
    """The ringing after a step: undamped natural frequency, damping, rms residual of the fit."""

    natural_hz: float
    damping_ratio: float
    misfit_um: float


def ringing(displacement_um: F64, sample_rate_hz: float) -> Ringing | None:
    """Fit the ringing of a displacement, float64[n], after a step; None if there is none."""
    if displacement_um.size < 2 * _FEWEST or not np.ptp(displacement_um) > 0.0:
        return None
    lowest_hz = _LOWEST_CYCLES * sample_rate_hz / displacement_um.size
    tried = [
        _start(displacement_um, sample_rate_hz, hz)
        for hz in np.geomspace(lowest_hz, _HIGHEST * sample_rate_hz, _FREQUENCIES)
    ]
    starts = sorted(tried, key=lambda start: start[0])[:_REFINED]
    found = [_refined(displacement_um, sample_rate_hz, start[1]) for start in starts]
    fits = [fit for fit, amplitude in found if amplitude > _SEEN * fit.misfit_um]
    best = min(fits, key=lambda fit: fit.misfit_um, default=None)
    return best if best and best.damping_ratio < _MOST_DAMPING else None


def _shapes(t: F64, x: F64) -> F64:
    """Return both phases of the ringing, the creep, and a constant: float64[4, n]."""
    # x: logarithms of natural angular frequency, damping ratio, and creep rate.
    omega, damping, rate = np.exp(x)
    decay, damped = np.exp(-damping * omega * t), omega * math.sqrt(max(1.0 - damping**2, 1e-6))
    ring = decay * np.cos(damped * t), decay * np.sin(damped * t)
    return np.stack([*ring, np.exp(-rate * t), np.ones(t.size)])


def _left(shapes: F64, y: F64) -> tuple[F64, F64]:
    """Return the residual of a least-squares fit of shapes, and its coefficients."""
    sizes = np.asarray(np.linalg.lstsq(shapes.T, y, rcond=None)[0], dtype=np.float64)
    return np.asarray(sizes @ shapes - y), sizes


def _window(displacement_um: F64, sample_rate_hz: float, hz: float) -> tuple[F64, F64]:
    count = max(_FEWEST, round(_CYCLES / hz * sample_rate_hz))
    y = displacement_um[:count]
    return np.arange(y.size) / sample_rate_hz, y


def _start(displacement_um: F64, sample_rate_hz: float, hz: float) -> tuple[float, F64]:
    """Return the misfit ratio of a ringing at a frequency, and starting values."""
    t, y = _window(displacement_um, sample_rate_hz, hz)
    omega = 2.0 * math.pi * hz
    best, start = math.inf, np.empty(0)
    creeps = math.inf
    for part in _RATES:
        for damping in _DAMPINGS:
            x = np.log([omega, damping, part * omega])
            shapes = _shapes(t, x)
            rms = float(np.linalg.norm(_left(shapes, y)[0]))
            if rms < best:
                best, start = rms, x
        creeps = min(creeps, float(np.linalg.norm(_left(shapes[2:], y)[0])))
    return best / max(creeps, 1e-300), start


def _refined(displacement_um: F64, sample_rate_hz: float, start: F64) -> tuple[Ringing, float]:
    """Return the fit from starting values, and the amplitude of its ringing in um."""
    t, y = _window(displacement_um, sample_rate_hz, math.exp(start[0]) / (2.0 * math.pi))
    spread = np.log([1.5, 20.0, 1e2])
    high = np.minimum(start + spread, [math.inf, math.log(0.98), math.inf])

    def left_by(x: F64) -> F64:
        return _left(_shapes(t, x), y)[0]

    found = least_squares(left_by, start, bounds=(start - spread, high))
    left, sizes = _left(_shapes(t, found.x), y)
    omega, damping, _ = np.exp(found.x)
    misfit_um = float(np.sqrt(np.mean(np.square(left))))
    fit = Ringing(float(omega / (2.0 * math.pi)), float(damping), misfit_um)
    return fit, math.hypot(sizes[0], sizes[1])
