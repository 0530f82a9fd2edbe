"""Bounded least squares, linear and from a start."""

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from hilctl.base.types import F64
from hilctl.lab.identify.least_squares import (
    SETTLED_STEP,
    SearchPoint,
    bounded_and_free,
    descend,
    numbered,
    settle,
    smooth_densities,
)

RNG = np.random.default_rng(6)


def test_what_the_data_leave_open_is_shared_evenly():
    column = RNG.normal(size=200)
    columns = np.stack([column, column], axis=1)
    table = np.array([[0, 1]])
    found, constant = smooth_densities(columns, 3.0 * column + 2.0, np.zeros(2), table, 0.01)
    np.testing.assert_allclose(found, 1.5, rtol=1e-5)
    assert abs(constant - 2.0) < 1e-5


def test_densities_that_the_data_give_are_found():
    columns, truth = RNG.normal(size=(300, 6)), np.array([0.5, 0.0, 2.0, 1.0, 0.3, 0.1])
    table = numbered(np.array([True, True, False, True, True, True, True, False])).reshape(2, 4)
    assert table.tolist() == [[0, 1, -1, 2], [3, 4, 5, -1]]
    least = np.array([0.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    target = columns @ np.maximum(truth, least) - 1.0
    found, constant = smooth_densities(columns, target, least, table, 0.01)
    np.testing.assert_allclose(found, np.maximum(truth, least), atol=1e-3)
    assert found[4] >= 0.4
    assert abs(constant + 1.0) < 1e-3


RANDOM = np.random.default_rng(5)


def test_linear_problem_with_bounds_is_solved():
    table, target = RANDOM.normal(size=(50, 6)), RANDOM.normal(size=50)
    low, high = np.full(6, -0.05), np.full(6, 0.08)
    x, errors = descend(lambda x: (table @ x - target, table), np.zeros(6), low, high, 60)
    expected = lsq_linear(table, target, (low, high), tol=1e-14)
    assert float(errors @ errors) == pytest.approx(2.0 * expected.cost, rel=1e-3)
    np.testing.assert_allclose(x, expected.x, atol=2e-3)
    assert np.any(x == low) or np.any(x == high)


def test_curved_problem_ends_where_scipy_does():
    time = np.linspace(0.0, 1.0, 80)
    target = 2.0 * np.exp(-3.0 * time) + 0.1 * np.cos(40.0 * time)

    def evaluate(x: F64) -> tuple[F64, F64]:
        decay = np.exp(-x[1] * time)
        slopes = np.column_stack([decay, -x[0] * time * decay, np.ones(80)])
        return x[0] * decay + x[2] - target, slopes

    low, high = np.array([0.0, 0.0, 0.3]), np.array([5.0, 10.0, 0.3])
    x, errors = descend(evaluate, np.array([1.0, 1.0, 0.3]), low, high, 60)
    assert x[2] == 0.3
    free = least_squares(lambda p: evaluate(np.array([*p, 0.3]))[0], [1.0, 1.0])
    assert float(errors @ errors) == pytest.approx(2.0 * free.cost, rel=1e-3)


def test_free_columns_have_any_sign():
    columns, free = RANDOM.normal(size=(60, 4)), RANDOM.normal(size=(60, 2))
    target = RANDOM.normal(size=60)
    scale, least = RANDOM.uniform(0.5, 2.0, 60), np.array([0.1, 0.0, 0.0, 0.0])
    w, c = bounded_and_free(columns, free, target, scale, least)
    table = np.column_stack([columns, free]) * scale[:, None]
    low = np.concatenate([least, [-np.inf, -np.inf]])
    expected = lsq_linear(table, target * scale, (low, np.inf), tol=1e-14).x
    np.testing.assert_allclose(np.concatenate([w, c]), expected, atol=1e-7)


MATRIX = np.random.default_rng(5).standard_normal((40, 3))
WANTED = np.array([1.0, -2.0, 0.5])
UNIT = np.array([1.0, 0.1, 2.0])


def errors(x: F64, bent: float) -> F64:
    """Return what is 0 at the end, bent so that no straight step leads there."""
    away = x - WANTED
    return np.asarray(MATRIX @ (away + bent * away**3))


def settled(bent: float, low: float = -9.0, high: float = 9.0, start: float = 0.0) -> F64:
    """Return the end of a search for the least sum of squares."""

    def place_of(x: F64) -> SearchPoint:
        here = errors(x, bent)
        slopes = MATRIX * (1.0 + 3.0 * bent * (x - WANTED) ** 2)
        return SearchPoint(float(here @ here), slopes.T @ here, slopes.T @ slopes)

    bounds = np.full(3, low), np.full(3, high)
    return settle(lambda x: place_of(x).squares, place_of, np.full(3, start), bounds, UNIT)


@pytest.mark.parametrize("bent", [0.0, 0.1])
def test_the_end_is_found(bent):
    x = settled(bent)
    assert np.abs((x - WANTED) / UNIT).max() < 3.0 * SETTLED_STEP


def test_a_bound_is_kept_and_the_rest_is_best_on_it():
    x = settled(0.0, low=-1.0, high=0.8)
    assert x[:2] == pytest.approx([0.8, -1.0], abs=SETTLED_STEP)
    rest = errors(np.array([0.8, -1.0, 0.0]), 0.0)
    best = -(MATRIX[:, 2] @ rest) / (MATRIX[:, 2] @ MATRIX[:, 2])
    assert x[2] == pytest.approx(best, abs=2.0 * SETTLED_STEP * UNIT[2])


def test_a_start_beyond_its_bounds_is_brought_within():
    assert np.abs(settled(0.0, low=-3.0, high=3.0, start=50.0)).max() <= 3.0


def test_what_makes_no_difference_stays():
    def place_of(x: F64) -> SearchPoint:
        return SearchPoint(
            float((x[0] - 2.0) ** 2), np.array([x[0] - 2.0, 0.0]), np.diag([1.0, 0.0])
        )

    bounds = np.full(2, -9.0), np.full(2, 9.0)
    found = settle(lambda x: (x[0] - 2.0) ** 2, place_of, np.full(2, 0.5), bounds, np.ones(2))
    assert found == pytest.approx([2.0, 0.5], abs=SETTLED_STEP)
