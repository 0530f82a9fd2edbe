"""Search problems of play models."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import nnls

from hilctl.base.types import F64
from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.fit_api import FitData, FitRequest
from hilctl.identify.fit_model import fit_model
from hilctl.identify.searched.plays import ExponentialProblem, PlaysProblem
from hilctl.identify.settings import FitSettings
from tests.unit.identify.conftest import OMEGA

Loops = Callable[..., list[SteadyLoop]]


@pytest.fixture
def data(loops_of: Loops) -> FitData:
    """Loops that none of the models below fits."""
    return FitData(loops_of(OMEGA, [(3.0, 10.0), (6.0, 150.0)]))


def differences(run: Callable[[F64], F64], x: F64, step: float) -> F64:
    steps = step * np.eye(x.size)
    return np.stack([(run(x + by) - run(x - by)) / (2.0 * step) for by in steps], axis=1)


@pytest.mark.parametrize("kind", ["ppi", "rdpi"])
@pytest.mark.parametrize("weights", ["free", "exponential"])
def test_gradient_where_the_weights_follow(data, kind, weights):
    problem = PlaysProblem(data, FitSettings(kind=kind, weights=weights, plays=6, offset=True))
    x, scale = problem.space.guess, 1.0 + (np.arange(data.target_um.size + problem.held) % 3)

    def square(at: F64) -> F64:
        return np.array([np.sum((problem.error_um(at, scale) * scale) ** 2)])

    errors = problem.error_um(x, scale) * scale
    gradient = 2.0 * errors @ (problem.slopes_um(x, scale) * scale[:, None])
    expected = differences(square, x, 1e-5)[0]
    np.testing.assert_allclose(gradient, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())


def test_free_weights_are_one_density_without_spikes(data):
    """Neighbours differ by a fifth; least squares alone would let them jump by nine tenths.

    The first and the last stand for all plays beyond them.
    """
    settings = FitSettings(kind="rdpi", plays=20, offset=True, starts=2)
    found = fit_model(FitRequest(data.records, settings))
    inner = np.array(found.model.weights)[1:-1]
    assert inner.min() > 0.05 * inner.max()
    assert np.abs(np.diff(inner)).max() < 0.25 * inner.max()


def test_samples_decide_where_they_can(data):
    problem = PlaysProblem(data, FitSettings(kind="rdpi", weights="free", plays=20))
    x, scale = problem.space.guess, np.ones(data.target_um.size + problem.held)
    held = problem.error_um(x, scale)[: data.target_um.size]
    columns = data.columns(np.array(problem.build(x, scale).thresholds), problem._growth_s(x))
    bare, _ = nnls(columns, data.target_um)
    least = columns @ bare - data.target_um
    assert np.linalg.norm(held) < 1.01 * np.linalg.norm(least)


@pytest.mark.parametrize("choices", [{}, {"offset": True, "layout": "midpoint"}])
def test_slopes_of_the_exponential_problem(data, choices):
    problem = ExponentialProblem(data, FitSettings(kind="integrated", **choices))
    x, ones = 1.1 * problem.space.guess + 0.01, np.ones(data.target_um.size)
    found = problem.slopes_um(x, ones)
    expected = differences(lambda at: problem.error_um(at, ones), x, 1e-5)
    assert found.shape == expected.shape
    for i in range(x.size):
        missed = np.linalg.norm(found[:, i] - expected[:, i])
        assert missed <= 2e-3 * np.linalg.norm(expected[:, i]), i
