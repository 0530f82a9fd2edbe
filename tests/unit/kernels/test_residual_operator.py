"""Plays, drags and rate of a displacement: bounded, and undone."""

from itertools import pairwise

import numpy as np
import pytest

from hilctl.kernels.residual_operator import residual_forward, residual_inverse

PLAYS, DRAGS, CELLS, WINDOW = 4, 2, 6, 5
LOW, WIDTH = -30.0, 10.0
EDGES = LOW + WIDTH * np.arange(CELLS + 1)


def numbers(seed=1, size=0.02):
    """Slopes of the plays, and tables of drags and rate."""
    rng = np.random.default_rng(seed)
    slopes = size * rng.normal(size=(PLAYS, CELLS))
    return slopes, 0.4 * rng.normal(size=(2 * DRAGS + 1, CELLS + 1))


def tables(slopes, lines):
    values = np.zeros((PLAYS, CELLS + 1))
    np.cumsum(slopes * WIDTH, axis=1, out=values[:, 1:])
    values -= np.array([[np.interp(0.0, EDGES, line)] for line in values])
    most = np.abs(values).max(axis=1).sum() + np.abs(lines).max(axis=1).sum()
    grid = np.array([LOW, WIDTH, float(CELLS), 2.0, most + 1e-3])
    return (
        np.array([0.0, 2.0, 6.0, 15.0]),
        np.array([4.0, 30.0]),
        values.ravel(),
        lines.ravel(),
        grid,
    )


def rest():
    memory = np.zeros(PLAYS + DRAGS + WINDOW + 2)
    memory[-1] = np.nan
    return memory


def path(samples=3000):
    t = np.arange(samples)
    return 24.0 * np.sin(t / 90.0) * np.minimum(t / 500.0, 1.0) + 4.0 * np.sin(t / 17.0)


def given(x, parts, memory=None):
    out = np.empty_like(x)
    residual_forward(x, parts, rest() if memory is None else memory, out)
    return out


def test_the_inverse_undoes_it_within_its_tolerance():
    parts = tables(*numbers())
    y, x = 1.6 * path(), np.empty(3000)
    residual_inverse(y, parts, rest(), x)
    assert np.abs(given(x, parts) - y).max() <= 2e-6
    assert np.abs(x - y).max() > 0.1


def test_it_is_bounded_and_its_inverse_finite_where_no_slope_is_right():
    parts = tables(*numbers(size=3.0))
    y, x = path(), np.empty(3000)
    residual_inverse(y, parts, rest(), x)
    assert np.isfinite(x).all()
    assert np.abs(x - y).max() <= parts[4][4]


def test_drags_do_not_depend_on_how_finely_a_way_is_cut():
    slopes, lines = np.zeros((PLAYS, CELLS)), numbers()[1]
    lines[-1] = 0.0
    parts = tables(slopes, lines)
    corners = np.array([0.0, 20.0, -5.0, 11.0])
    fine = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(corners)])
    assert given(fine, parts)[-1] == pytest.approx(given(corners, parts)[-1], abs=1e-9)


def test_what_is_no_number_leaves_no_trace():
    parts, x = tables(*numbers()), path(50)
    broken = np.insert(x, 20, [np.nan, np.inf])
    for kernel in (residual_forward, residual_inverse):
        whole, out = np.empty(50), np.empty(52)
        kernel(x, parts, rest(), whole)
        kernel(broken, parts, rest(), out)
        assert np.isnan(out[20:22]).all()
        np.testing.assert_array_equal(np.delete(out, [20, 21]), whole)


def test_a_memory_that_is_none_becomes_no_index():
    memory = np.full(PLAYS + DRAGS + WINDOW + 2, np.nan)
    out = np.empty(3)
    residual_inverse(np.array([1.0, 2.0, 3.0]), tables(*numbers()), memory, out)
    residual_forward(np.array([1.0, 2.0, 3.0]), tables(*numbers()), memory, out)
