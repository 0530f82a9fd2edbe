"""A descent on problems whose end is known."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.identify.field.gauss_newton import SETTLED, STEPS, TRIALS, SearchPoint, settle

MATRIX = np.random.default_rng(5).standard_normal((40, 3))
WANTED = np.array([1.0, -2.0, 0.5])
UNIT = np.array([1.0, 0.1, 2.0])


def errors(x: F64, bent: float) -> F64:
    """Return what is 0 at the end, bent so that no straight step leads there."""
    away = x - WANTED
    return np.asarray(MATRIX @ (away + bent * away**3))


class Counted:
    """A sum of squares that counts how often it is asked for."""

    def __init__(self, bent: float) -> None:
        self.bent, self.tried, self.taken = bent, 0, 0

    def sum_of(self, x: F64) -> float:
        self.tried += 1
        return float(np.sum(errors(x, self.bent) ** 2))

    def place_of(self, x: F64) -> SearchPoint:
        self.taken += 1
        here = errors(x, self.bent)
        slopes = MATRIX * (1.0 + 3.0 * self.bent * (x - WANTED) ** 2)
        return SearchPoint(float(here @ here), slopes.T @ here, slopes.T @ slopes)


def settled(bent: float, low: float = -9.0, high: float = 9.0) -> tuple[F64, Counted]:
    counted = Counted(bent)
    bounds = np.full(3, low), np.full(3, high)
    return settle(counted.sum_of, counted.place_of, np.zeros(3), bounds, UNIT), counted


@pytest.mark.parametrize("bent", [0.0, 0.1])
def test_the_end_is_found(bent: float) -> None:
    x, _ = settled(bent)
    assert np.abs((x - WANTED) / UNIT).max() < 3.0 * SETTLED


def test_a_bound_is_kept_and_the_rest_is_best_on_it() -> None:
    x, _ = settled(0.0, low=-1.0, high=0.8)
    assert x[:2] == pytest.approx([0.8, -1.0], abs=SETTLED)
    rest = errors(np.array([0.8, -1.0, 0.0]), 0.0)
    best = -(MATRIX[:, 2] @ rest) / (MATRIX[:, 2] @ MATRIX[:, 2])
    assert x[2] == pytest.approx(best, abs=2.0 * SETTLED * UNIT[2])


def test_a_start_beyond_its_bounds_is_brought_within() -> None:
    counted = Counted(0.0)
    bounds = np.full(3, -3.0), np.full(3, 3.0)
    x = settle(counted.sum_of, counted.place_of, np.full(3, 50.0), bounds, UNIT)
    assert np.abs(x).max() <= 3.0


def test_no_more_steps_than_there_may_be() -> None:
    _, counted = settled(30.0)
    assert counted.tried <= TRIALS
    assert counted.taken <= STEPS + 1


def test_what_makes_no_difference_stays() -> None:
    """No slope and no curvature: neither is divided by."""

    def place_of(x: F64) -> SearchPoint:
        return SearchPoint(
            float((x[0] - 2.0) ** 2), np.array([x[0] - 2.0, 0.0]), np.diag([1.0, 0.0])
        )

    bounds = np.full(2, -9.0), np.full(2, 9.0)
    found = settle(lambda x: (x[0] - 2.0) ** 2, place_of, np.full(2, 0.5), bounds, np.ones(2))
    assert found == pytest.approx([2.0, 0.5], abs=SETTLED)
