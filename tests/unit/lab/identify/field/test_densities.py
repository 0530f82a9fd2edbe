"""One least squares for all densities and the curve: formulas, conditions and invariances."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.lab.identify.field.densities import STEEPEST, Curve, Equations, Grid, Weights, table

GRID = Grid(np.array([0.0, 1.0]), -6.0, 12.0, 4, 6)
SLOPES = np.array([[5.0, 7.0, 7.0, 5.0], [1.0, 2.0, 2.0, 1.0]])
LEAST = 0.05


def columns() -> F64:
    """Return what a path through all cells gives: float64[800, 8]."""
    t = np.linspace(0.0, 1.0, 800)
    u = 5.8 * np.sin(2.0 * np.pi * 5.0 * t) * (0.2 + 0.8 * t)
    return table([np.ascontiguousarray(u)], [np.arange(u.size)], GRID)


def operators(slopes: F64, given: F64) -> F64:
    """Return the operators' output, which is 0 at rest."""
    return np.asarray(given @ slopes.ravel())


def displacement_um(given: F64) -> F64:
    """Return a displacement that saturates: 40 tanh(m / 50)."""
    return np.asarray(40.0 * np.tanh(operators(SLOPES, given) / 50.0))


def solved(y: F64, least: float = LEAST) -> Weights:
    """Return the weights for a displacement, each row of the same weight."""
    return Equations(columns(), y, 0.0 * y, GRID, least, np.ones(y.size)).solve()


def test_a_curve_goes_through_its_points_and_on_straight():
    curve = Curve(np.array([-3.0, 0.0, 8.0]), np.array([-1.0, 0.0, 2.0]))
    y = np.array([-2.0, -1.0, -0.5, 0.0, 1.0, 2.0, 3.0])
    assert curve.operators_of(y).tolist() == [-6.0, -3.0, -1.5, 0.0, 4.0, 8.0, 12.0]


def test_plays_by_hand_each_record_from_rest():
    """Up by 1 from rest: a play of 1 has not moved."""
    up, far = np.array([0.0, 1.0]), np.array([7.0])
    got = table([far, up], [np.array([0]), np.array([0, 1])], GRID)
    assert got.shape == (3, GRID.plays * GRID.splines)
    # Two pieces of 6, the second from rest on: up by 1 is a sixth of it, and 7 is 1 beyond its end.
    t = 1.0 / 6.0
    sixth = [0.0, (1.0 - (1.0 - t) ** 3) / 6.0, 0.5 * (t + t**2) - t**3 / 3.0, t**3 / 6.0]
    assert got[0, :4] == pytest.approx([0.0, 1.0, 4.5, 1.5])
    assert got[0, 4:8] == pytest.approx([0.0, 1.0, 4.0, 1.0])
    assert got[1] == pytest.approx(np.zeros(8))
    assert got[2, :4] == pytest.approx(6.0 * np.array(sixth))
    assert got[2, 4:] == pytest.approx(np.zeros(4))


def test_what_is_found_gives_the_displacement():
    y = displacement_um(columns()) + 5.0
    found = solved(y)
    assert np.std(found.errors_um) < 0.005 * np.ptp(y)
    assert found.offset_um == pytest.approx(5.0, abs=0.5)
    assert (found.slopes >= 0.0).all()
    assert (found.slopes[0] >= LEAST).all()


def test_errors_are_modelled_less_measured():
    y = displacement_um(columns()) + np.random.default_rng(1).normal(0.0, 0.05, 800)
    found = solved(y)
    m = operators(found.slopes, columns())
    modelled = np.interp(m, found.curve.operators, found.curve.displacement_um) + found.offset_um
    # Not quite: an error of the operators' is brought to um by the curve's slope, not by the curve.
    assert np.std(found.errors_um - (modelled - y)) < 0.1 * np.std(found.errors_um)
    assert np.std(found.errors_um) > 0.04


def test_the_curve_rises_through_rest_with_a_mean_slope_of_1():
    curve = solved(displacement_um(columns()) + 5.0).curve
    assert curve.operators_of(np.zeros(1)) == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(curve.operators) == pytest.approx(np.ptp(curve.displacement_um))
    slopes = np.diff(curve.operators) / np.diff(curve.displacement_um)
    assert slopes.min() >= 1.0 / STEEPEST - 1e-9
    assert slopes[0] > slopes[2] < slopes[-1]  # the inverse of what saturates


def test_the_curve_is_held_to_a_steepest_slope():
    y = 40.0 * np.tanh(operators(SLOPES, columns()) / 5.0)
    curve = solved(np.asarray(y)).curve
    slopes = np.diff(curve.operators) / np.diff(curve.displacement_um)
    assert slopes.min() == pytest.approx(1.0 / STEEPEST)


def test_no_slope_of_the_first_line_is_less_than_the_least():
    given = columns()
    found = solved(given[:, 4:8].sum(axis=1), least=0.4)
    assert found.slopes[0] == pytest.approx(0.4, abs=0.1)
    assert found.slopes[0].min() >= 0.4


def test_a_column_that_does_not_move_has_no_weight():
    u = np.ascontiguousarray(2.5 * np.sin(np.linspace(0.0, 30.0, 500)))
    grid = replace(GRID, thresholds=np.array([0.0, 1.0, 2.5]))
    given = table([u], [np.arange(u.size)], grid)
    found = Equations(given, given.sum(axis=1), 0.0 * u, grid, LEAST, np.ones(u.size)).solve()
    assert (found.slopes[2] == 0.0).all()  # a play as wide as the motion
    assert (found.slopes[0] >= LEAST).all()
    assert found.slopes[1, 1:3].min() > 0.0


def test_units_of_the_displacement_make_no_difference():
    y = displacement_um(columns()) + 5.0
    one, ten = solved(y), solved(10.0 * y, least=10.0 * LEAST)
    assert ten.slopes == pytest.approx(10.0 * one.slopes, rel=1e-4, abs=1e-6)
    assert ten.curve.operators == pytest.approx(10.0 * one.curve.operators, rel=1e-5, abs=1e-4)
    assert ten.offset_um == pytest.approx(10.0 * one.offset_um, rel=1e-6)
    assert ten.errors_um == pytest.approx(10.0 * one.errors_um, abs=1e-3)


@pytest.mark.parametrize("shift_um", [-20.0, 60.0])
def test_where_a_sensor_has_its_zero_makes_no_difference(shift_um):
    y = displacement_um(columns())
    one, shifted = solved(y), solved(y + shift_um)
    assert shifted.slopes == pytest.approx(one.slopes, rel=1e-6, abs=1e-6)
    assert shifted.offset_um == pytest.approx(one.offset_um + shift_um, abs=1e-6)
    assert shifted.curve.displacement_um == pytest.approx(one.curve.displacement_um, abs=1e-6)


def test_a_row_counts_by_the_square_of_its_scale():
    """Two rows of weight 1 are one of twice the weight; rows of no weight cannot pull."""
    y, given = displacement_um(columns()), columns()
    y[::2] += 0.5
    scale = np.where(np.arange(y.size) % 2, 1.0, 1e-9)
    freed = Equations(given, y, 0.0 * y, GRID, LEAST, scale).solve()
    assert np.mean(freed.errors_um[::2]) == pytest.approx(-0.5, abs=0.05)
    assert np.mean(freed.errors_um[1::2]) == pytest.approx(0.0, abs=0.01)
    twice = np.vstack([given, given]), np.concatenate([y, y]), np.zeros(2 * y.size)
    both = Equations(*twice, GRID, LEAST, np.concatenate([scale, scale])).solve()
    heavy = Equations(given, y, 0.0 * y, GRID, LEAST, math.sqrt(2.0) * scale).solve()
    assert both.slopes == pytest.approx(heavy.slopes, rel=1e-6, abs=1e-6)


def test_noise_that_is_known_does_not_bend_the_curve():
    clean = displacement_um(columns())
    noise_um = np.random.default_rng(3).normal(0.0, 2.0, clean.size)
    true = solved(clean).curve
    rise = 0.5 * (true.operators_of(clean + 1.0) - true.operators_of(clean - 1.0))
    known = Equations(columns(), clean, rise * noise_um, GRID, LEAST, np.ones(clean.size)).solve()
    y = np.linspace(clean.min(), clean.max())
    bent = [
        np.abs(each.curve.operators_of(y) - true.operators_of(y)).max()
        for each in (known, solved(clean + noise_um))
    ]
    assert bent[0] < 0.3 * bent[1]
