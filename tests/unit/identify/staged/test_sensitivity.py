"""Kernels of the staged fit: slopes against differences, values against a solver."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hilctl.identify.staged.sensitivity import (
    GAMMA_S,
    GROWTH,
    LAG_S,
    PARAMETERS,
    SPACING,
    lagged,
    plays_and_slopes,
)

N, STEP_S = 200, 1e-4
V = 3.0 * np.sin(2.0 * np.pi * np.arange(N) / N) + 0.5 * np.sin(6.0 * np.pi * np.arange(N) / N)
NUMBERS, WEIGHTS = np.arange(1.0, 5.0), np.array([0.5, 0.2, 0.0, 1.0])


def after_lag(lag_s, growth, substeps=8):
    w, dw = V.copy(), np.zeros((N, PARAMETERS))
    lagged(V, STEP_S, lag_s, growth, substeps, N, w, dw)
    return w, dw


@pytest.mark.parametrize(("lag_s", "growth"), [(3e-4, 0.0), (3e-4, 0.8), (2e-3, 0.2)])
def test_slopes_of_the_lag(lag_s, growth):
    _, dw = after_lag(lag_s, growth)
    by_lag = after_lag(lag_s * (1 + 1e-5), growth)[0] - after_lag(lag_s * (1 - 1e-5), growth)[0]
    np.testing.assert_allclose(dw[:, LAG_S], by_lag / (2e-5 * lag_s), rtol=1e-5, atol=1e-3)
    up, down = after_lag(lag_s, growth + 1e-6)[0], after_lag(lag_s, growth - 1e-6)[0]
    np.testing.assert_allclose(dw[:, GROWTH], (up - down) / 2e-6, atol=1e-5)


@pytest.mark.parametrize("growth", [0.0, 0.8])
def test_the_lag_solves_its_equation_in_the_steady_cycle(growth):
    """w' = (v - w) / (lag (1 + growth |v - w|)), v straight between its points."""
    times = STEP_S * np.arange(3 * N)

    def rate(t, w):
        behind = np.interp(t, times, np.tile(V, 3)) - w
        return behind / (3e-4 * (1.0 + growth * abs(behind)))

    solved = solve_ivp(rate, (0.0, times[-1]), [0.0], t_eval=times, max_step=STEP_S, rtol=1e-8)
    np.testing.assert_allclose(after_lag(3e-4, growth)[0], solved.y[0, 2 * N :], atol=2e-3)


def played(spacing, gamma_s, turns=2):
    w, dw = after_lag(3e-4, 0.2)
    speed = np.abs(np.gradient(V, STEP_S))
    out, slopes = np.empty((N, NUMBERS.size)), np.empty((N, PARAMETERS))
    plays_and_slopes(w, dw, speed, spacing, gamma_s, NUMBERS, WEIGHTS, turns, out, slopes)
    return out, slopes


def test_slopes_of_the_plays():
    """Weighted with the plays' weights; a kink's own sample may differ."""
    spacing, gamma_s = 0.3, 5e-5
    slopes = played(spacing, gamma_s)[1]
    for column, up, down, step in (
        (SPACING, played(spacing + 1e-6, gamma_s), played(spacing - 1e-6, gamma_s), 1e-6),
        (GAMMA_S, played(spacing, gamma_s + 1e-10), played(spacing, gamma_s - 1e-10), 1e-10),
    ):
        expected = (up[0] - down[0]) @ WEIGHTS / (2.0 * step)
        near = np.isclose(slopes[:, column], expected, rtol=1e-4, atol=1e-4 * np.ptp(expected))
        assert near.mean() > 0.95, column


def test_a_second_turn_forgets_the_rest_that_it_came_from():
    """Plays of a steady cycle end as they began."""
    np.testing.assert_array_equal(played(0.3, 5e-5)[0], played(0.3, 5e-5, turns=3)[0])
    assert not np.array_equal(played(0.3, 5e-5)[0], played(0.3, 5e-5, turns=1)[0])
