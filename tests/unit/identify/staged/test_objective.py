"""The sum of squares of the staged model: its derivatives agree with differences."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.objective import Layers, bounds, error_and_slopes, loop_delay_s
from tests.staged import start

Loops = Callable[..., list[SteadyLoop]]


@pytest.mark.parametrize(
    ("layers", "before"),
    [
        (Layers(6, 4, half_period_s=1e-4), [1e-4, 0.3, 0.8, 0.0]),
        (Layers(6, 4, lag=False, gamma=True, structure=False, delay=False), [0.0, 0.0, 0.8, 2e-4]),
    ],
)
def test_derivatives_agree_with_differences(
    data: StagedFitData, layers: Layers, before: list[float]
) -> None:
    """Analytic derivatives by every parameter equal central differences."""
    point = start(data, layers, before, 3e-4 if layers.lag else 0.0)
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
def test_a_sampled_loop_has_a_delay_that_is_not_the_model_s(lag_s: float) -> None:
    """What a sampled lag is late at a low frequency, less the lag's own time constant."""
    period_s, low_hz = 1e-3, 0.01
    step = 1j * 2.0 * np.pi * low_hz * period_s
    left = np.exp(-period_s / lag_s)
    sampled = (1.0 - left) * np.exp(-step) / (1.0 - left * np.exp(-step))
    late_s = -np.angle(sampled) / (2.0 * np.pi * low_hz)
    assert loop_delay_s(0.5 * period_s, lag_s) == pytest.approx(late_s - lag_s, rel=1e-5)


def test_the_longest_lag_leaves_half_a_period_and_none_a_whole_one() -> None:
    assert loop_delay_s(5e-6, 1.0) == pytest.approx(5e-6, rel=1e-4)
    assert loop_delay_s(5e-6, 0.0) == 1e-5
    assert loop_delay_s(0.0, 1e-4) == 0.0
