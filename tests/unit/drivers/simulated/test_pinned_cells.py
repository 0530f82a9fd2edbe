"""Compiled steps of lag and cells against plain formulas."""

import math

import numpy as np
import pytest

from hilctl_drivers.simulated.pinned_cells import _advance_field, _langevin, free_displacement

MATERIAL = (10_000.0, 50.0, 0.3)


@pytest.mark.parametrize("x", [-30.0, -0.5, -0.021, 0.021, 0.5, 30.0, 500.0])
def test_langevin_is_its_formula(x):
    assert _langevin(x) == pytest.approx(1.0 / math.tanh(x) - 1.0 / x, rel=1e-9)


def test_langevin_is_smooth_and_odd_where_its_formula_cancels():
    """Series and formula meet; at 0 it is 0, with a slope of a third."""
    assert _langevin(0.0) == 0.0
    assert _langevin(1e-9) == pytest.approx(1e-9 / 3.0, rel=1e-12)
    edge = 0.02
    assert _langevin(np.nextafter(edge, 0.0)) == pytest.approx(_langevin(edge), rel=1e-9)
    assert _langevin(-0.01) == -_langevin(0.01)


def test_cells_hold_until_the_field_is_beyond_their_pinning():
    cells = np.array([[100.0, 1000.0], [0.5, 0.5], [0.0, 0.0]])
    free_displacement(cells, 600.0, MATERIAL)
    assert cells[2].tolist() == [500.0, 0.0]
    free_displacement(cells, 550.0, MATERIAL)
    assert cells[2].tolist() == [500.0, 0.0]
    free_displacement(cells, 300.0, MATERIAL)
    assert cells[2].tolist() == [400.0, 0.0]


def test_displacement_does_not_know_the_field_s_sign():
    """Magnetostriction is even: x = lambda (M^2 + b M^4)."""
    cells = np.array([[0.0], [1.0], [0.0]])
    positive = free_displacement(cells, 8000.0, MATERIAL)
    negative = free_displacement(np.array([[0.0], [1.0], [0.0]]), -8000.0, MATERIAL)
    m2 = _langevin(0.8) ** 2
    assert positive == negative == pytest.approx(50.0 * m2 * (1.0 + 0.3 * m2))


def test_a_field_step_is_the_exponential_where_nothing_grows():
    """Fourth order: for a step of a tenth of the lag within 1e-7."""
    found = _advance_field(0.0, (1.0, 1.0, 1.0), 1e-5, 1e-4, 0.0)
    assert found == pytest.approx(-math.expm1(-0.1), abs=1e-7)
    assert _advance_field(0.0, (1.0, 1.0, 1.0), 1e-5, 1e-4, 2.0) < found
