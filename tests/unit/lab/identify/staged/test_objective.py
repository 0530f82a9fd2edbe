"""The sum of squares of the staged model: its derivatives agree with differences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.identify.fit_data import FitData, Linear
from hilctl.lab.identify.staged.objective import (
    Layers,
    Point,
    bounds,
    error_and_slopes,
    in_loop,
    loop_delay_s,
    parameters,
    staged_model,
    structure_of,
)
from hilctl.models.linear_stages import FirstMode
from tests.staged import start
from tests.unit.lab.identify.conftest import OMEGA


@pytest.mark.parametrize(("layers", "before"), [
    (Layers(6, 4, half_period_s=1e-4), [1e-4, 0.3, 0.8, 0.0]),
    (Layers(6, 4, stages=False, gamma=True), [0.0, 0.0, 0.8, 2e-4]),
])  # fmt: skip
def test_derivatives_agree_with_differences(data, layers, before):
    point = start(data, layers, before, 3e-4 if layers.stages else 0.0)
    point = replace(point, weights=point.weights + 0.1)  # a weight of 0 has no relative step
    x = point.pack()
    _, slopes = error_and_slopes(data, layers, point)
    low, high = bounds(data, layers, point)
    for i in np.flatnonzero(high > low):
        step = np.zeros(x.size)
        step[i] = 1e-6 * max(abs(x[i]), 1e-3 if i > 6 else 1e-12)
        above, _ = error_and_slopes(data, layers, point.unpack(x + step))
        below, _ = error_and_slopes(data, layers, point.unpack(x - step))
        numeric = (above - below) / (2.0 * step[i])
        assert np.linalg.norm(slopes[:, i] - numeric) < 0.02 * np.linalg.norm(numeric) + 1e-9, i


@pytest.mark.parametrize("lag_s", [2e-5, 1e-4, 1e-3])
def test_a_sampled_loop_has_a_delay_that_is_not_the_model_s(lag_s):
    period_s, low_hz = 1e-3, 0.01
    step = 1j * 2.0 * np.pi * low_hz * period_s
    left = np.exp(-period_s / lag_s)
    sampled = (1.0 - left) * np.exp(-step) / (1.0 - left * np.exp(-step))
    late_s = -np.angle(sampled) / (2.0 * np.pi * low_hz)
    assert loop_delay_s(0.5 * period_s, lag_s) == pytest.approx(late_s - lag_s, rel=1e-5)


def test_the_longest_lag_leaves_half_a_period_and_none_a_whole_one():
    assert loop_delay_s(5e-6, 1.0) == pytest.approx(5e-6, rel=1e-4)
    assert loop_delay_s(5e-6, 0.0) == 1e-5
    assert loop_delay_s(0.0, 1e-4) == 0.0


HALF_S = 1e-5
LAYERS = Layers(plays=2, deadbands=1, half_period_s=HALF_S)
RADIAN_S = 1.0 / (2.0 * math.pi * 2000.0)
POINT = Point(
    before=np.array([1e-4, 0.3, 0.5, 0.0]), linear=Linear(5e-5, 0.3 * RADIAN_S, RADIAN_S**2),
    direct=3.0, weights=np.array([1.0, 0.5]), spacings_um=(6.0, 5.0), up=np.array([0.8]),
    down=np.array([1.2]), offset_um=-2.0,
)  # fmt: skip


@pytest.fixture
def data(loops_of):
    omega = OMEGA.model_copy(update={"gamma_s": 0.0})
    loops = loops_of(omega, [(6.0, 100.0)])
    return FitData(loops)


def test_a_low_pass_keeps_its_time_constant_and_is_a_structure():
    """A sensor of 1 kHz has no mass: whatever the search found for one is too small to matter."""
    low_pass = Linear(0.0, 1.6e-4, 1e-14)
    natural_hz, damping = structure_of(low_pass)
    FirstMode(natural_hz=natural_hz, damping_ratio=damping)
    assert damping / (np.pi * natural_hz) == pytest.approx(1.6e-4)
    s = 2j * np.pi * 250.0
    kept = 1.0 / (1.0 + s * 1.6e-4 + (s / (2.0 * np.pi * natural_hz)) ** 2)
    assert kept == pytest.approx(low_pass.response(np.array([s]))[0], abs=1e-3)


def test_parameters_are_under_their_published_names():
    found = {name: value for name, (value, _) in parameters(LAYERS, POINT).items()}
    assert found["delay_s"] == 5e-5
    assert (found["a_1"], found["a_2"], found["g_0"]) == (1.0, 0.5, 1.0)
    assert found["g_1"] == pytest.approx(-0.2)
    assert found["g_-1"] == pytest.approx(0.2)
    assert "delay_s" not in parameters(replace(LAYERS, stages=False), POINT)


def test_a_model_has_the_stages_of_its_point(data):
    model = staged_model(data, LAYERS, POINT)
    assert (model.lag.tau_s, model.lag.growth_per_unit) == (1e-4, 0.3)
    assert model.structure.natural_hz == pytest.approx(2000.0)
    assert model.hysteresis.thresholds == pytest.approx((0.5, 1.0))
    late_s = POINT.linear.delay_s + loop_delay_s(HALF_S, 1e-4)
    assert in_loop(LAYERS, POINT) == replace(POINT.linear, delay_s=late_s)
