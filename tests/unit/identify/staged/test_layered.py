"""The sum of squares of the staged model: its derivatives agree with differences."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.staged.convex import convex_start
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.layered import Layers, Point, bounds, error_and_slopes
from hilctl.models.published import exponential_integrated
from hilctl.models.staged import FieldLag, StagedModel

Loops = Callable[..., list[SteadyLoop]]
GRID = [(a, f) for a in (3.0, 6.0) for f in (2.0, 50.0, 150.0, 250.0, 400.0)]


def truth(**stages: Any) -> StagedModel:
    """Return a known model; its deadbands lie where identification puts them."""
    omega = exponential_integrated(
        alpha=0.5,
        gamma_s=0.0,
        a_0=3.0,
        alpha_0=1.4,
        beta_0=0.3,
        g_0=1.0,
        alpha_1=0.08,
        beta_1=0.15,
        d_p=6.0,
        alpha_2=0.1,
        beta_2=0.4,
        d_n=6.0,
        plays=8,
        deadbands_a_side=5,
    )
    return StagedModel.around(omega, **stages)


@pytest.fixture
def data(loops_of: Loops) -> StagedFitData:
    loops = loops_of(truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3)), GRID[::3])
    return StagedFitData(loops, FitData(loops).speeds)


def start(data: StagedFitData, layers: Layers, before: list[float], delay_s: float) -> Point:
    scale = np.ones(data.target_um.size)
    return convex_start(data, layers, np.array(before), delay_s, scale).point


@pytest.mark.parametrize(
    ("layers", "before"),
    [
        (Layers(6, 4, least_delay_s=1e-5), [1e-4, 0.3, 0.8, 0.0]),
        (Layers(6, 4, lag=False, gamma=True, structure=False, delay=False), [0.0, 0.0, 0.8, 2e-4]),
    ],
)
def test_derivatives_agree_with_differences(
    data: StagedFitData, layers: Layers, before: list[float]
) -> None:
    """Analytic derivatives by every parameter equal central differences."""
    point = start(data, layers, before, 3e-5 if layers.lag else 0.0)
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
