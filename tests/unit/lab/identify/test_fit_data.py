"""Records for a fit with dynamics, and the kernels of lag and plays."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_data import PARAMETERS, FitData, Linear, lagged, plays_and_slopes

POINTS, FREQUENCY_HZ = 300, 100.0
PHASE = 2.0 * np.pi * np.arange(POINTS) / POINTS


def loop(amplitude=6.0, frequency_hz=FREQUENCY_HZ):
    command = amplitude * np.sin(PHASE)
    return SteadyLoop(f"{amplitude}", command, 5.0 * command + 1.0, frequency_hz, 50_000.0)


def test_a_delay_moves_each_loop_by_its_own_time():
    data = FitData([loop(), loop(3.0, 50.0)])
    late = data.through(data.target_um[:, None], Linear(delay_s=1e-3))[:, 0]
    moved = np.concatenate([
        1.0 + 30.0 * np.sin(PHASE - 2.0 * np.pi * 100.0 * 1e-3),
        1.0 + 15.0 * np.sin(PHASE - 2.0 * np.pi * 50.0 * 1e-3),
    ])  # fmt: skip
    np.testing.assert_allclose(late, moved, atol=1e-9)
    back = data.through(late[:, None], Linear(delay_s=-1e-3))[:, 0]
    np.testing.assert_allclose(back, data.target_um, atol=1e-9)


def test_a_lag_keeps_the_mean_and_lowers_the_swing():
    data = FitData([loop()])
    (after,), (slopes,) = data.lagged(1e-3, 0.0)
    gain = 1.0 / abs(1.0 + 2j * np.pi * FREQUENCY_HZ * 1e-3)
    assert np.ptp(after) == pytest.approx(12.0 * gain, rel=1e-3)
    assert after.mean() == pytest.approx(0.0, abs=1e-3)
    assert np.any(slopes[:, 0])
    (same,), _ = data.lagged(0.0, 0.0)
    np.testing.assert_array_equal(same, loop().command)


N, STEP_S = 200, 1e-4
V = 3.0 * np.sin(2.0 * np.pi * np.arange(N) / N) + 0.5 * np.sin(6.0 * np.pi * np.arange(N) / N)
NUMBERS, WEIGHTS = np.arange(1.0, 5.0), np.array([0.5, 0.2, 0.0, 1.0])


def after_lag(lag_s, growth, substeps=8):
    w, dw = V.copy(), np.zeros((N, PARAMETERS))
    lagged(V, STEP_S, lag_s, growth, substeps, N, w, dw)
    return w, dw


@pytest.mark.parametrize("growth", [0.0, 0.8])
def test_the_lag_solves_its_equation_in_the_steady_cycle(growth):
    """w' = (v - w) / (lag (1 + growth |v - w|)), v straight between its points."""
    times = STEP_S * np.arange(3 * N)

    def rate(t, w):
        behind = np.interp(t, times, np.tile(V, 3)) - w
        return behind / (3e-4 * (1.0 + growth * abs(behind)))

    solved = solve_ivp(rate, (0.0, times[-1]), [0.0], t_eval=times, max_step=STEP_S, rtol=1e-8)
    np.testing.assert_allclose(after_lag(3e-4, growth)[0], solved.y[0, 2 * N :], atol=2e-3)


def played(turns):
    w, dw = after_lag(3e-4, 0.2)
    speed = np.abs(np.gradient(V, STEP_S))
    out, slopes = np.empty((N, NUMBERS.size)), np.empty((N, PARAMETERS))
    plays_and_slopes(w, dw, speed, 0.3, 5e-5, NUMBERS, WEIGHTS, turns, out, slopes)
    return out


def test_a_second_turn_forgets_the_rest_that_it_came_from():
    np.testing.assert_array_equal(played(2), played(3))
    assert not np.array_equal(played(2), played(1))
