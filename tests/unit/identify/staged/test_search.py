"""The search for lag, hysteresis, structure and delay: its peak goal, and what it refuses."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.settings import FitSettings
from hilctl.identify.staged.fit_data import StagedFitData
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


def fit(data: list[SteadyLoop], **choices: Any) -> FittedModel:
    settings = FitSettings(kind="staged", plays=8, deadbands=5, starts=2, **choices)
    return fit_model(data, settings, lambda: 0.0)


@pytest.fixture
def data(loops_of: Loops) -> StagedFitData:
    loops = loops_of(truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3)), GRID[::3])
    return StagedFitData(loops, FitData(loops).speeds)


def test_peak_goal_lowers_the_peak(loops_of: Loops) -> None:
    """With a goal in reach the peak error falls below that of least squares."""
    made = truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3))
    loops = loops_of(made, GRID[::2])
    choices: dict[str, Any] = {"structure": False, "delay": False, "lag": "plain"}
    plain = fit(loops, **choices)
    refined = fit(loops, peak_goal_percent=0.8 * plain.peak_percent, **choices)
    assert refined.peak_percent < plain.peak_percent


def test_whole_histories_and_wrong_choices_are_refused(loops_of: Loops) -> None:
    """Dynamics need steady loops; stages belong to staged models."""
    command = 3.0 * np.sin(0.02 * np.arange(2000))
    history = History("growing", command, 5.0 * command, 10_000.0)
    with pytest.raises(DataError, match=r"found from steady loops.*leave out --whole"):
        fit([history])  # type: ignore[list-item]
    loops = loops_of(truth(), GRID[:2])
    with pytest.raises(DataError, match="found from runs at one sample rate"):
        fit([loops[0], replace(loops[1], sample_rate_hz=10_000.0)])
