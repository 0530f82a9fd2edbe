"""Fit of a short FIR to a measured frequency response.

Taps are ``spacing`` samples apart and smoothed by four moving averages over ``spacing`` samples, as
:class:`hilctl.experiment.sections.coupling.CrosstalkFilter` applies them. Fewer measured lines than
taps of the full rate then determine them.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import C128, F64
from hilctl.signals.cycle_metrics import rms

_TAPS_PER_CYCLE = 3.0  # of the highest measured frequency
_SHORTEST, _MOST_AHEAD = 8, 16  # taps
_NOISE = 1e-3  # least noise of a line, of the response
_SMALLEST = 1e-2  # of singular values, the smallest one used
_BETTER = 1.1  # more taps must lower the residual by this factor
_ENOUGH = 0.02  # residual of the response below which more taps are not worth it


@dataclass(frozen=True, slots=True)
class FirFit:
    """A fitted FIR.

    Attributes:
        first_sample: Delay of the first tap; negative if it looks ahead.
        taps: float64[m]; one is a static gain.
        residuals: complex128[k], error at each frequency if it is left out of the fit.
    """

    first_sample: int
    spacing: int
    taps: F64
    residuals: C128


def fit_fir(frequency_hz: F64, response: C128, noise: F64, sample_rate_hz: float) -> FirFit:
    """Fit the shortest FIR whose residual is near the least, weighted with the noise.

    Args:
        frequency_hz: float64[k], the highest last.
        response: complex128[k].
        noise: float64[k], standard deviation of each.
        sample_rate_hz: Rate of the taps.
    """
    weights = 1.0 / np.hypot(noise, _NOISE * rms(np.abs(response)))
    found = [_fit(frequency_hz, response, weights, sample_rate_hz, 1, 1)]
    spacing = max(1, int(sample_rate_hz / (_TAPS_PER_CYCLE * frequency_hz[-1])))
    taps = _SHORTEST
    while taps <= frequency_hz.size:
        found.append(_fit(frequency_hz, response, weights, sample_rate_hz, spacing, taps))
        taps *= 2
    residuals = [rms(np.abs(each.residuals)) for each in found]
    enough = max(_BETTER * min(residuals), _ENOUGH * rms(np.abs(response)))
    return next(each for each, left in zip(found, residuals, strict=True) if left <= enough)


def _fit(
    frequency_hz: F64, response: C128, weights: F64, rate_hz: float, spacing: int, taps: int
) -> FirFit:
    """Return the weighted fit of a number of taps by a truncated singular value decomposition."""
    first = -spacing * min(taps // 4, _MOST_AHEAD)
    angle = 2.0 * math.pi * frequency_hz / rate_hz
    average = np.sin(0.5 * spacing * angle) / (spacing * np.sin(0.5 * angle))
    delays = first + spacing * np.arange(taps)
    basis = average[:, None] ** 4 * np.exp(-1j * angle[:, None] * delays)
    both = np.concatenate([(basis * weights[:, None]).real, (basis * weights[:, None]).imag])
    wanted = np.concatenate([(response * weights).real, (response * weights).imag])
    u, sizes, rows = np.linalg.svd(both, full_matrices=False)
    used = sizes > _SMALLEST * sizes[0]
    u, sizes, rows = u[:, used], sizes[used], rows[used]
    found = rows.T @ (u.T @ wanted / sizes)
    leverage = (u**2).sum(axis=1).reshape(2, -1).sum(axis=0)  # of both parts of a line, 0 to 2
    residuals = (response - basis @ found) / np.maximum(1.0 - 0.5 * leverage, 1e-3)
    return FirFit(first, spacing, found, residuals)
