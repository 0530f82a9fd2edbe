"""Bounded least squares by itself."""

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from hilctl.base.types import F64
from hilctl.identify.nnls import bounded_and_free
from hilctl.identify.staged.bounded_lsq import descend

RNG = np.random.default_rng(5)


def test_linear_problem_with_bounds_is_solved() -> None:
    """Weights within bounds equal those of an independent solver."""
    table, target = RNG.normal(size=(50, 6)), RNG.normal(size=50)
    low, high = np.full(6, -0.05), np.full(6, 0.08)
    x, errors, slopes = descend(lambda x: (table @ x - target, table), np.zeros(6), low, high, 60)
    expected = lsq_linear(table, target, (low, high), tol=1e-14)
    assert float(errors @ errors) == pytest.approx(2.0 * expected.cost, rel=1e-3)
    np.testing.assert_allclose(x, expected.x, atol=2e-3)
    assert np.any(x == low) or np.any(x == high)
    assert slopes is table


def test_curved_problem_ends_where_scipy_does() -> None:
    """A nonlinear fit ends at the same sum of squares; equal bounds hold a parameter."""
    time = np.linspace(0.0, 1.0, 80)
    target = 2.0 * np.exp(-3.0 * time) + 0.1 * np.cos(40.0 * time)

    def evaluate(x: F64) -> tuple[F64, F64]:
        decay = np.exp(-x[1] * time)
        slopes = np.column_stack([decay, -x[0] * time * decay, np.ones(80)])
        return x[0] * decay + x[2] - target, slopes

    low, high = np.array([0.0, 0.0, 0.3]), np.array([5.0, 10.0, 0.3])
    x, errors, _ = descend(evaluate, np.array([1.0, 1.0, 0.3]), low, high, 60)
    assert x[2] == 0.3
    free = least_squares(lambda p: evaluate(np.array([*p, 0.3]))[0], [1.0, 1.0])
    assert float(errors @ errors) == pytest.approx(2.0 * free.cost, rel=1e-3)


def test_free_columns_have_any_sign() -> None:
    """Bounded and free weights together equal an independent solver's."""
    columns, free, target = RNG.normal(size=(60, 4)), RNG.normal(size=(60, 2)), RNG.normal(size=60)
    scale, least = RNG.uniform(0.5, 2.0, 60), np.array([0.1, 0.0, 0.0, 0.0])
    w, c = bounded_and_free(columns, free, target, scale, least)
    table = np.column_stack([columns, free]) * scale[:, None]
    low = np.concatenate([least, [-np.inf, -np.inf]])
    expected = lsq_linear(table, target * scale, (low, np.inf), tol=1e-14).x
    np.testing.assert_allclose(np.concatenate([w, c]), expected, atol=1e-7)
