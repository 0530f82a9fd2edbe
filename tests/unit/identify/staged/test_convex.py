"""Weights that follow from lag and thresholds, without a search."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.staged.convex import convex_start
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.layered import Layers, Point, error_and_slopes
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


def test_weights_follow_without_a_search(data: StagedFitData) -> None:
    """With lag, spacing and delay known, the linear problem alone is within 1 % of the stroke."""
    layers = Layers(8, 5, structure=False)
    point = start(data, layers, [1e-4, 0.3, 0.5, 0.0], data.half_period_s)
    errors, _ = error_and_slopes(data, layers, point)
    assert np.max(np.abs(errors)) < 0.01 * data.stroke_um
