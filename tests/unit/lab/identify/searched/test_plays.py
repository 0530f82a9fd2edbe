"""Search problems of play models."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from hilctl.base.types import F64
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.least_squares import bounded_weights, first_least
from hilctl.lab.identify.searched.plays import (
    ExponentialProblem,
    PlaysProblem,
    SearchSpace,
    search,
)
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.plays import PlayModel
from tests.unit.lab.identify.conftest import OMEGA

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


@pytest.mark.parametrize("choices", [{}, {"offset": True}])
def test_slopes_of_the_exponential_problem(data, choices):
    problem = ExponentialProblem(data, FitSettings(kind="integrated", **choices))
    x, ones = 1.1 * problem.space.guess + 0.01, np.ones(data.target_um.size)
    found = problem.slopes_um(x, ones)
    expected = differences(lambda at: problem.error_um(at, ones), x, 1e-5)
    assert found.shape == expected.shape
    for i in range(x.size):
        missed = np.linalg.norm(found[:, i] - expected[:, i])
        assert missed <= 2e-3 * np.linalg.norm(expected[:, i]), i


TIME = np.linspace(0.0, 1.0, 200)


class Curve:
    """Fit x_0 sin(x_1 t) to a signal: a sum of squares with many minima in x_1."""

    space = SearchSpace.of({"x_0": (0.0, 10.0, 1.0), "x_1": (1.0, 60.0, 8.0)})

    def __init__(self, target: F64) -> None:
        self.target = target

    held = 0

    def error_um(self, x: F64, scale: F64) -> F64:
        return np.asarray(x[0] * np.sin(x[1] * TIME) - self.target, dtype=np.float64)

    def slopes_um(self, x: F64, scale: F64) -> F64:
        phase = x[1] * TIME
        return np.column_stack([np.sin(phase), x[0] * TIME * np.cos(phase)])

    def build(self, x: F64, scale: F64) -> PlayModel:
        raise AssertionError

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        return {"x_0": float(x[0]), "x_1": float(x[1])}


def quiet(done: float, text: str) -> None:
    pass


@pytest.mark.parametrize("offset", [True, False])
def test_bounded_weights_agree_with_bounded_least_squares(offset):
    rng = np.random.default_rng(3)
    columns, target = rng.normal(size=(60, 5)), rng.normal(size=60) + 2.0
    scale, least = rng.uniform(0.5, 2.0, 60), np.array([0.1, 0.0, 0.2, 0.0, 0.0])
    weights, constant = bounded_weights(columns, target, scale, least, offset=offset)
    table = np.column_stack([columns, np.ones(60)]) if offset else columns
    low = np.append(least, -np.inf) if offset else least
    expected = lsq_linear(table * scale[:, None], target * scale, (low, np.inf), tol=1e-14).x
    np.testing.assert_allclose(weights, expected[:5], atol=1e-7)
    assert constant == pytest.approx(expected[5] if offset else 0.0, abs=1e-7)
    assert np.any(weights == least)


def test_several_starts_find_what_the_first_misses():
    problem, scale = Curve(3.0 * np.sin(23.0 * TIME)), np.ones(200)
    lonely = search(problem, scale, 6.0, 1, np.random.default_rng(0), quiet)
    assert lonely[1][0].rms_percent > 10.0
    found = [search(problem, scale, 6.0, 6, np.random.default_rng(0), quiet) for _ in range(2)]
    np.testing.assert_allclose(found[0][0], [3.0, 23.0], rtol=1e-6)
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert [start.start for start in found[0][1]] == [
        "data",
        *[f"random {i}" for i in range(1, 6)],
    ]


def test_progress_rises_and_counts_starts():
    """Progress goes up from 0 and names each start."""
    told: list[tuple[float, str]] = []
    search(
        Curve(np.sin(5.0 * TIME)),
        np.ones(200),
        2.0,
        3,
        np.random.default_rng(0),
        lambda done, text: told.append((done, text)),
    )
    parts = [done for done, _ in told]
    assert parts == sorted(parts)
    assert parts[0] == 0.0
    assert [text for _, text in told][:3] == [f"start {i} of 3" for i in (1, 2, 3)]


def test_the_first_of_equal_ends_is_taken():
    assert first_least([2.0, 1.0 + 1e-9, 1.0]) == 1
    assert first_least([2.0, 1.001, 1.0]) == 2
