"""The search by itself: bounded weights, several starts, and the refinement for the peak."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from hilctl.base.types import F64
from hilctl.identify.least_squares import bounded_weights, first_least
from hilctl.identify.searched.search import SearchSpace, refine_peak, search
from hilctl.models.plays import PlayModel

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
    assert lonely.starts[0].rms_percent > 10.0
    found = [search(problem, scale, 6.0, 6, np.random.default_rng(0), quiet) for _ in range(2)]
    np.testing.assert_allclose(found[0].x, [3.0, 23.0], rtol=1e-6)
    np.testing.assert_array_equal(found[0].x, found[1].x)
    assert [start.start for start in found[0].starts] == [
        "data",
        *[f"random {i}" for i in range(1, 6)],
    ]
    assert all(start.rms_percent <= start.first_rms_percent for start in found[0].starts)


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


def test_refinement_lowers_the_peak_at_the_cost_of_the_rms():
    bump = np.exp(-(((TIME - 0.3) / 0.01) ** 2))
    problem, scale = Curve(3.0 * np.sin(6.0 * TIME) + bump), np.ones(200)
    found = search(problem, scale, 6.0, 3, np.random.default_rng(0), quiet)
    before = problem.error_um(found.x, scale)
    peak = float(np.max(np.abs(before)))
    refined = refine_peak(problem, found, 0.8 * peak, quiet)
    after = problem.error_um(refined.x, refined.scale)
    assert np.max(np.abs(after)) <= 0.8 * peak
    assert np.sum(after**2) > np.sum(before**2)


def test_refinement_out_of_reach_keeps_the_best():
    bump = np.exp(-(((TIME - 0.3) / 0.01) ** 2))
    problem, scale = Curve(3.0 * np.sin(6.0 * TIME) + bump), np.ones(200)
    found = search(problem, scale, 6.0, 3, np.random.default_rng(0), quiet)
    refined = refine_peak(problem, found, 1e-3, quiet)
    before = np.max(np.abs(problem.error_um(found.x, scale)))
    assert np.max(np.abs(problem.error_um(refined.x, refined.scale))) < before


def test_the_first_of_equal_ends_is_taken():
    assert first_least([2.0, 1.0 + 1e-9, 1.0]) == 1
    assert first_least([2.0, 1.001, 1.0]) == 2
