"""Derivatives of the search for plays agree with differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hilctl.base.arrays import F64
from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.searched.plays import PlaysProblem
from hilctl.identify.settings import FitSettings
from hilctl.models.published import exponential_integrated

Loops = Callable[..., list[SteadyLoop]]


@pytest.fixture
def data(loops_of: Loops) -> FitData:
    """Loops that none of the models below fits."""
    omega = exponential_integrated(
        alpha=0.33, gamma_s=2.5e-4, a_0=3.0, alpha_0=1.4, beta_0=0.23, g_0=1.0, alpha_1=0.08,
        beta_1=0.15, d_p=4.0, alpha_2=0.1, beta_2=0.4, d_n=3.0,
    )  # fmt: skip
    return FitData(loops_of(omega, [(3.0, 10.0), (6.0, 150.0)]))


def differences(run: Callable[[F64], F64], x: F64, step: float) -> F64:
    steps = step * np.eye(x.size)
    return np.stack([(run(x + by) - run(x - by)) / (2.0 * step) for by in steps], axis=1)


@pytest.mark.parametrize("kind", ["ppi", "rdpi"])
@pytest.mark.parametrize("weights", ["free", "exponential"])
def test_gradient_where_the_weights_follow(data: FitData, kind: Any, weights: Any) -> None:
    """Slopes lack what the weights make up for, and yet give the gradient of the sum of squares."""
    problem = PlaysProblem(data, FitSettings(kind=kind, weights=weights, plays=6, offset=True))
    x, scale = problem.space.guess, 1.0 + (np.arange(data.target_um.size) % 3)

    def square(at: F64) -> F64:
        return np.array([np.sum((problem.error_um(at, scale) * scale) ** 2)])

    errors = problem.error_um(x, scale) * scale
    gradient = 2.0 * errors @ (problem.slopes_um(x, scale) * scale[:, None])
    expected = differences(square, x, 1e-5)[0]
    np.testing.assert_allclose(gradient, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())
