"""Weights that follow from lag and thresholds, without a search."""

from collections.abc import Callable

import numpy as np

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.objective import Layers, error_and_slopes
from tests.staged import start

Loops = Callable[..., list[SteadyLoop]]


def test_weights_follow_without_a_search(data: StagedFitData) -> None:
    """With lag, spacing and delay known, the linear problem alone is within 1 % of the stroke."""
    layers = Layers(8, 5, structure=False)
    point = start(data, layers, [1e-4, 0.3, 0.5, 0.0], data.half_period_s)
    errors, _ = error_and_slopes(data, layers, point)
    assert np.max(np.abs(errors)) < 0.01 * data.stroke_um
