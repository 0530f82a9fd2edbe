"""Kernels of the fit: a field lag and play operators, with their derivatives by the parameters."""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

LAG_S, GROWTH, SPACING, GAMMA_S = range(4)
"""Columns of every derivative by a parameter that acts before the deadbands."""
PARAMETERS = 4


@kernel("UniTuple(float64, 3)(float64, float64, float64, float64)")
def _relaxed(behind: float, slope: float, lag: float, step: float) -> tuple[float, float, float]:
    """Return e after a step of e' = slope - e / lag, and its derivatives by e and by lag."""
    left = math.exp(-step / lag)
    rest = behind - slope * lag
    by_lag = slope * (1.0 - left) + rest * left * step / (lag * lag)
    return slope * lag + rest * left, left, by_lag


@kernel(
    "void(float64[::1], float64, float64, float64, int64, int64, float64[::1], float64[:, ::1])"
)
def lagged(
    v: F64, step_s: float, lag_s: float, growth: float, substeps: int, settle: int, w: F64, dw: F64
) -> None:
    """Let a command that repeats go through w' = (v - w) / (lag (1 + growth |v - w|)).

    Between its points the command is a straight line; each substep is exact for the lag at its
    middle.

    Args:
        v: float64[n], one cycle.
        step_s: Time between its points.
        lag_s: Time constant for small changes.
        growth: Relative growth of the lag per unit that w is behind.
        substeps: Steps between two points.
        settle: Points before the first one that are gone through to reach the steady cycle.
        w: float64[n], filled.
        dw: float64[n, 4], filled with derivatives by lag and growth; other columns are 0.
    """
    n = v.size
    step = step_s / substeps
    e = 0.0
    e_lag = 0.0
    e_growth = 0.0
    for j in range(-settle, n):
        slope = (v[j % n] - v[(j - 1) % n]) / step_s
        for _ in range(substeps):
            size = abs(e)
            sign = math.copysign(growth * lag_s, e)
            lag = lag_s * (1.0 + growth * size)
            lag_1 = 1.0 + growth * size + sign * e_lag
            lag_2 = lag_s * size + sign * e_growth
            middle, by_e, by_lag = _relaxed(e, slope, lag, 0.5 * step)
            m_1 = by_e * e_lag + by_lag * lag_1
            m_2 = by_e * e_growth + by_lag * lag_2
            size = abs(middle)
            sign = math.copysign(growth * lag_s, middle)
            lag = lag_s * (1.0 + growth * size)
            lag_1 = 1.0 + growth * size + sign * m_1
            lag_2 = lag_s * size + sign * m_2
            e, by_e, by_lag = _relaxed(e, slope, lag, step)
            e_lag = by_e * e_lag + by_lag * lag_1
            e_growth = by_e * e_growth + by_lag * lag_2
        if j >= 0:
            w[j] = v[j] - e
            dw[j, 0] = -e_lag
            dw[j, 1] = -e_growth


@kernel(
    "void(float64[::1], float64[:, ::1], float64[::1], float64, float64, float64[::1],"
    " float64[::1], int64, float64[:, ::1], float64[:, ::1])"
)
def plays_and_slopes(
    w: F64,
    dw: F64,
    speed: F64,
    spacing: float,
    gamma_s: float,
    numbers: F64,
    weights: F64,
    turns: int,
    out: F64,
    slopes: F64,
) -> None:
    """Run plays of thresholds ``spacing numbers_i + gamma speed``, from rest.

    Args:
        w: float64[n], input.
        dw: float64[n, 4], its derivatives by the parameters.
        speed: float64[n], |rate| of the input.
        spacing: Distance of two thresholds.
        gamma_s: Growth of the thresholds with the speed.
        numbers: float64[m], thresholds in units of the spacing.
        weights: float64[m].
        turns: Times that the input is gone through; the last one counts. Two bring plays to the
            steady state of a cycle, see :meth:`hilctl.identify.data.records.SteadyLoop.run`.
        out: float64[n, m], filled with each play's output.
        slopes: float64[n, 4], filled with the derivatives of the weighted sum of the plays.
    """
    held = np.zeros(numbers.size)
    by = np.zeros((numbers.size, 4))
    for _ in range(turns):
        for k in range(w.size):
            wide = gamma_s * speed[k]
            for q in range(4):
                slopes[k, q] = 0.0
            for i in range(numbers.size):
                threshold = spacing * numbers[i] + wide
                side = 0.0
                if held[i] < w[k] - threshold:
                    side = -1.0
                elif held[i] > w[k] + threshold:
                    side = 1.0
                if side != 0.0:
                    held[i] = w[k] + side * threshold
                    by[i, 0] = dw[k, 0]
                    by[i, 1] = dw[k, 1]
                    by[i, 2] = side * numbers[i]
                    by[i, 3] = side * speed[k]
                out[k, i] = held[i]
                for q in range(4):
                    slopes[k, q] += weights[i] * by[i, q]
