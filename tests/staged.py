"""A known staged model, and the grid and the fit that identify it."""

from typing import Any

import numpy as np

from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.settings import FitSettings
from hilctl.lab.identify.staged.objective import Layers, Point
from hilctl.lab.identify.staged.staged_fits import convex_start
from hilctl.models.integrated import exponential_integrated
from hilctl.models.staged import StagedModel

GRID = [(a, f) for a in (3.0, 6.0) for f in (2.0, 50.0, 150.0, 250.0, 400.0)]
"""Amplitude in the command's unit, frequency in Hz."""


def truth(**stages: Any) -> StagedModel:
    """Return a known model; its deadbands are on the grid of identification."""
    omega = exponential_integrated(
        alpha=0.5, gamma_s=0.0, a_0=3.0, alpha_0=1.4, beta_0=0.3, g_0=1.0, alpha_1=0.08,
        beta_1=0.15, d_p=6.0, alpha_2=0.1, beta_2=0.4, d_n=6.0, plays=8, deadbands_a_side=5,
    )  # fmt: skip
    return StagedModel.around(omega, **stages)


def fit(data: list[SteadyLoop], **choices: Any) -> FittedModel:
    """Identify a staged model of that structure."""
    settings = FitSettings(kind="staged", plays=8, deadbands=5, starts=2, **choices)
    return fit_model(FitRequest(data, settings))


def start(data: FitData, layers: Layers, before: list[float], delay_s: float) -> Point:
    """Return the start of the search, the solution of the linear problem."""
    scale = np.ones(data.target_um.size)
    return convex_start(data, layers, np.array(before), delay_s, scale)[1]
