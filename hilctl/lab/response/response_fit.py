"""Fit of gain, delay, lag and up to three modes to a frequency response."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from hilctl.base.types import C128, F64
from hilctl.models.linear_stages import MODE_NUMBERS, modes_of, second_order

_HYSTERESIS = 0.03  # share of a line that no linear response explains
_DISTORTION = 0.01  # the same of the largest line: harmonics of a hysteresis reach all lines
_WORTH = 0.5  # share of the misfit that a resonance must explain
_MOST_DAMPING = 0.8
_MOST_FURTHER = 2  # modes beside the first
_WORTH_FURTHER = 0.25
_MOST_FURTHER_DAMPING = 0.3
_TRIES = 6  # starting frequencies of a mode
_CURVE_POINTS = 2000
_FITTED = ("gain_um", "delay_s", "lag_s", "natural_hz", "damping_ratio")


def _response(x: F64, frequency_hz: F64) -> C128:
    """Return the response of gain, delay, lag, and in ``x[3:]`` any modes: complex128[k].

    The first mode has two parameters, each further one two and two for its antiresonance.
    """
    s = 2j * np.pi * frequency_hz
    answer: C128 = np.exp(x[0] - s * x[1]) / (1.0 + s * x[2])
    for k in (3, *range(5, x.size, MODE_NUMBERS)) if x.size > 3 else ():
        answer /= second_order(frequency_hz, math.exp(x[k]), math.exp(x[k + 1]))
    for k in range(5, x.size, MODE_NUMBERS):
        answer *= second_order(frequency_hz, math.exp(x[k] + x[k + 2]), math.exp(x[k + 3]))
    return answer


def fitted_fields(
    hz: F64, response: C128, noise: F64, rate_hz: float, *, held: bool
) -> dict[str, Any]:
    """Return the fields of a fit to lines: float64[k], complex128[k], float64[k].

    ``held`` if the output follows a command that is held for a sample.
    """
    sign = math.copysign(1.0, response[0].real)
    turns = hz / rate_hz
    half = np.exp(-1j * np.pi * turns) if held else np.ones(hz.size, complex)
    # Dynamics slower than the samples smooth the steps; faster ones settle within a sample.
    holds = [half, half * np.sinc(turns)] if held else [half]
    fits = [
        (hold, _chosen(hz, sign * response / hold, noise / np.abs(hold), rate_hz)) for hold in holds
    ]
    hold, found = min(fits, key=lambda each: float(each[1].cost))
    fitted = sign * hold * _response(found.x, hz)
    x, errors = _lowest_first(found.x, _errors(found))
    gain, lag_s = math.exp(x[0]), float(x[2])
    mode = [*map(math.exp, x[3:5])]
    curve_hz = np.geomspace(hz[0], hz[-1], _CURVE_POINTS)
    below = np.flatnonzero(np.abs(_response(found.x, curve_hz)) < gain * math.sqrt(0.5))
    scales = dict(zip(_FITTED, (gain, 1.0, 1.0, *mode), strict=False))
    return {
        "gain_um": sign * gain,
        "delay_s": float(x[1]),
        "lag_s": lag_s if lag_s * hz[-1] > 1e-3 else 0.0,
        "natural_hz": mode[0] if mode else None,
        "damping_ratio": mode[1] if mode else None,
        "further": modes_of(x[5:]),
        "bandwidth_hz": float(curve_hz[below[0]]) if below.size else None,
        "errors": dict(
            zip(scales, (errors[: len(scales)] * [*scales.values()]).tolist(), strict=True)
        ),
        "misfit_percent": 100.0 * float(np.sqrt(np.mean(np.abs(fitted - response) ** 2))) / gain,
        "fitted": fitted,
    }


def _chosen(hz: F64, response: C128, noise: F64, rate_hz: float) -> OptimizeResult:
    """Return the fit, with as many modes in the band as explain most of the misfit each."""
    slope = np.polynomial.polynomial.polyfit(hz, np.unwrap(np.angle(response)), 1)[1]
    delay_s = min(max(-slope / (2.0 * np.pi), 0.5 / rate_hz), 100.0 / rate_hz)
    start = [math.log(abs(response[0])), 0.5 * delay_s, 0.02 / hz[-1]]
    found = _best(hz, response, noise, rate_hz, [start])
    further = math.log(0.05), 0.0, math.log(0.05)
    for added, worth, most_damping in (
        ((math.log(0.1),), _WORTH, _MOST_DAMPING),
        *[(further, _WORTH_FURTHER, _MOST_FURTHER_DAMPING)] * _MOST_FURTHER,
    ):
        if hz.size <= len(start) + len(added):  # two numbers per line: twice as many as parameters
            break
        if found.x.size > 3 and _misfit(found) < found.fun.size:
            break  # the residual is within the doubt of the lines
        worst_hz = hz[np.argmax(np.abs(response / _response(np.array(start), hz) - 1.0))]
        tries = worst_hz, *np.geomspace(2.0 * hz[0], hz[-1], _TRIES).tolist()
        starts = [[*start, math.log(each), *added] for each in tries]
        more = _best(hz, response, noise, rate_hz, starts)
        # An earlier mode may move, too: one beyond the lines is not supported by the data.
        natural_hz = np.exp(more.x[[3, *range(5, more.x.size, MODE_NUMBERS)]])
        plausible = natural_hz.max() < hz[-1] and math.exp(more.x[len(start) + 1]) < most_damping
        plausible &= math.exp(more.x[4]) < _MOST_DAMPING
        start = more.x.tolist()
        if plausible and _misfit(more) < worth * _misfit(found):
            found = more
        elif found.x.size > 3:
            break  # otherwise two modes may explain the misfit of one
    return found


def _misfit(found: OptimizeResult) -> float:
    """Return the sum of squares; a robust one hides the large residual of a missing mode."""
    return float(np.sum(found.fun**2))


def _lowest_first(x: F64, errors: F64) -> tuple[F64, F64]:
    """Return the parameters with the slowest mode as the first one, and their errors."""
    x, errors = x.copy(), errors.copy()
    slowest = min(range(5, x.size, MODE_NUMBERS), key=lambda k: float(x[k]), default=3)
    if x.size > 3 and x[slowest] < x[3]:
        x[slowest + 2] += x[slowest] - x[3]  # the antiresonance stays
        first, other = [3, 4], [slowest, slowest + 1]
        for each in (x, errors):
            each[first + other] = each[other + first]
    return x, errors


def _errors(found: OptimizeResult) -> F64:
    """Return the standard errors of the parameters from the Jacobian and the residuals."""
    rows, count = found.jac.shape
    variance = 2.0 * float(found.cost) / max(rows - count, 1)
    covariance = np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    errors: F64 = np.sqrt(np.maximum(variance * np.diag(covariance), 0.0))
    return errors


def _best(
    hz: F64, response: C128, noise: F64, rate_hz: float, starts: Sequence[Sequence[float]]
) -> OptimizeResult:
    """Return the best fit from several starts with the same number of parameters."""
    size = np.abs(response)
    doubt = np.hypot(np.hypot(noise, _HYSTERESIS * size), _DISTORTION * size.max())
    first, last = math.log(0.5 * hz[0]), math.log(1.5 * hz[-1])
    low = [-30.0, -1.0 / rate_hz, 0.0, first, math.log(1e-4)]
    high = [30.0, 1e4 / rate_hz, 1e3 / hz[-1], last, math.log(5.0)]
    low += [first, math.log(1e-4), -math.log(2.0), math.log(1e-4)] * _MOST_FURTHER
    high += [last, 0.0, math.log(2.0), 0.0] * _MOST_FURTHER
    bounds = low[: len(starts[0])], high[: len(starts[0])]

    def residuals(x: F64) -> F64:
        off = (_response(x, hz) - response) / doubt
        return np.concatenate((off.real, off.imag))

    fits = (
        least_squares(residuals, start, bounds=bounds, loss="soft_l1", x_scale="jac")
        for start in starts
    )
    return min(fits, key=lambda each: float(each.cost))
