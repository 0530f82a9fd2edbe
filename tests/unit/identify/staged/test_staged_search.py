"""The search for lag, hysteresis, structure and delay: its peak goal, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History
from hilctl.identify.staged.objective import Layers, error_and_slopes
from hilctl.models.staged import FieldLag
from tests.staged import GRID, fit, start, truth


def test_peak_goal_lowers_the_peak(loops_of):
    made = truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3))
    loops = loops_of(made, GRID[::2])
    choices = {"structure": False, "delay": False, "lag": "plain"}
    plain = fit(loops, **choices)
    refined = fit(loops, peak_goal_percent=0.8 * plain.peak_percent, **choices)
    assert refined.peak_percent < plain.peak_percent


def test_whole_histories_and_wrong_choices_are_refused(loops_of):
    command = 3.0 * np.sin(0.02 * np.arange(2000))
    history = History("growing", command, 5.0 * command, 10_000.0)
    with pytest.raises(DataError, match=r"--whole"):
        fit([history])
    loops = loops_of(truth(), GRID[:2])
    with pytest.raises(DataError, match="one sample rate"):
        fit([loops[0], replace(loops[1], sample_rate_hz=10_000.0)])


def test_weights_follow_without_a_search(data):
    """With lag, spacing and delay known, the linear problem alone is within 1 % of the stroke."""
    layers = Layers(8, 5, structure=False)
    point = start(data, layers, [1e-4, 0.3, 0.5, 0.0], data.half_period_s)
    errors, _ = error_and_slopes(data, layers, point)
    assert np.max(np.abs(errors)) < 0.01 * data.stroke_um
