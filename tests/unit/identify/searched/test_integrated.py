"""Analytic derivatives of the searches agree with differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.searched.integrated import ExponentialProblem
from hilctl.identify.settings import FitSettings
from hilctl.models.integrated import exponential_integrated

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


@pytest.mark.parametrize("choices", [{}, {"offset": True, "layout": "midpoint"}])
def test_slopes_of_the_exponential_problem(data: FitData, choices: dict[str, Any]) -> None:
    """Each of eleven or twelve parameters; kinks of plays leave a little."""
    problem = ExponentialProblem(data, FitSettings(kind="integrated", **choices))
    x, ones = 1.1 * problem.space.guess + 0.01, np.ones(data.target_um.size)
    found = problem.slopes_um(x, ones)
    expected = differences(lambda at: problem.error_um(at, ones), x, 1e-5)
    assert found.shape == expected.shape
    for i in range(x.size):
        missed = np.linalg.norm(found[:, i] - expected[:, i])
        assert missed <= 2e-3 * np.linalg.norm(expected[:, i]), i
