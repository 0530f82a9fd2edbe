"""Records for a fit with dynamics, and the kernels of lag and plays."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.staged.fit_data import (
    GAMMA_S,
    GROWTH,
    LAG_S,
    PARAMETERS,
    SPACING,
    Linear,
    StagedFitData,
    lagged,
    plays_and_slopes,
)

POINTS, FREQUENCY_HZ = 300, 100.0
PHASE = 2.0 * np.pi * np.arange(POINTS) / POINTS


def loop(amplitude=6.0, frequency_hz=FREQUENCY_HZ):
    command = amplitude * np.sin(PHASE)
    return SteadyLoop(f"{amplitude}", command, 5.0 * command + 1.0, frequency_hz, 50_000.0)


def data_of(*records):
    return StagedFitData(records, [np.abs(record.rate()) for record in records])


def test_a_delay_moves_each_loop_by_its_own_time():
    data = data_of(loop(), loop(3.0, 50.0))
    late = data.through(data.target_um[:, None], Linear(delay_s=1e-3))[:, 0]
    moved = np.concatenate([
        1.0 + 30.0 * np.sin(PHASE - 2.0 * np.pi * 100.0 * 1e-3),
        1.0 + 15.0 * np.sin(PHASE - 2.0 * np.pi * 50.0 * 1e-3),
    ])  # fmt: skip
    np.testing.assert_allclose(late, moved, atol=1e-9)
    back = data.through(late[:, None], Linear(delay_s=-1e-3))[:, 0]
    np.testing.assert_allclose(back, data.target_um, atol=1e-9)


def test_nothing_to_do_returns_the_signals_themselves():
    data = data_of(loop())
    signals = data.target_um[:, None]
    assert data.through(signals, Linear()) is signals
    assert Linear().none
    assert not Linear(q_s2=1e-9).none


def test_a_structure_answers_as_its_transfer_function():
    linear = Linear(c_s=1e-4, q_s2=1e-7)
    s = 2j * np.pi * FREQUENCY_HZ
    expected = 1.0 / (1.0 + s * 1e-4 + s * s * 1e-7)
    assert linear.response(np.array([s]))[0] == pytest.approx(expected)


def test_slopes_of_the_linear_stages_agree_with_differences():
    data = data_of(loop())
    at = np.array([2e-4, 1e-4, 1e-7])
    slopes = data.linear_slopes(data.target_um, Linear(*at))
    for i, step in enumerate((1e-8, 1e-8, 1e-11)):
        by = step * np.eye(3)[i]
        up, down = (data.through(data.target_um[:, None], Linear(*(at + s * by))) for s in (1, -1))
        expected = (up - down)[:, 0] / (2.0 * step)
        np.testing.assert_allclose(slopes[:, i], expected, rtol=1e-4, atol=1e-4 * np.ptp(expected))


def test_thinning_keeps_every_sixth_point_and_its_scale():
    data = data_of(loop(), loop(3.0))
    scale = np.arange(2.0 * POINTS)
    few, kept = data.thinned(scale, 50)
    np.testing.assert_array_equal(kept, np.concatenate((scale[:POINTS:6], scale[POINTS::6])))
    np.testing.assert_array_equal(few.target_um, data.target_um[kept.astype(int)])
    assert [place.stop - place.start for place in few.places] == [50, 50]
    assert data.target_um.size == 2 * POINTS


def test_a_lag_keeps_the_mean_and_lowers_the_swing():
    data = data_of(loop())
    (after,), (slopes,) = data.lagged(1e-3, 0.0)
    gain = 1.0 / abs(1.0 + 2j * np.pi * FREQUENCY_HZ * 1e-3)
    assert np.ptp(after) == pytest.approx(12.0 * gain, rel=1e-3)
    assert after.mean() == pytest.approx(0.0, abs=1e-3)
    assert np.any(slopes[:, 0])
    (same,), _ = data.lagged(0.0, 0.0)
    np.testing.assert_array_equal(same, loop().command)


def test_a_whole_history_has_no_harmonics():
    history = History("h", np.sin(np.arange(500) / 20.0), np.zeros(500) + np.arange(500), 1000.0)
    data = StagedFitData([history], [np.zeros(500)])
    assert not data.all_steady
    assert data_of(loop()).all_steady


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
    np.testing.assert_array_equal(played(0.3, 5e-5)[0], played(0.3, 5e-5, turns=3)[0])
    assert not np.array_equal(played(0.3, 5e-5)[0], played(0.3, 5e-5, turns=1)[0])
