"""Stages and thresholds followed down together, on rows whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.arrays import F64
from hilctl.identify.field.polish import ROOM, STAGES, Bare, Polish
from hilctl.identify.field.stages import HIGH, LOW, STEP, Stages, row
from hilctl.identify.field.weights import Equations, Grid, outputs, solve, table

TRUE_R = 0.85
GRID = Grid(np.array([0.0, 0.7, 1.4]), np.empty(0), -4.0, 1.6, 5, 4)
LEAST = 0.05


def path(gain: float = 1.0) -> F64:
    t = np.linspace(0.0, 1.0, 900)
    wave = np.sin(2 * np.pi * 5.0 * t) * (0.3 + 0.7 * t) + 0.3 * np.sin(2 * np.pi * 31.0 * t)
    return np.ascontiguousarray(2.6 * gain * wave)


KEPT = [np.arange(900)]


def displacement_um() -> F64:
    """Return what plays of no threshold and of the true one give along the path."""
    true = Grid(np.array([0.0, TRUE_R]), np.empty(0), -4.0, 1.6, 5, 4)
    return np.asarray(table([path()], KEPT, true) @ np.repeat([3.0, 2.0], 5))


def test_a_threshold_goes_to_where_the_rods_yield() -> None:
    y = displacement_um()
    polish = Polish(lambda _: Bare([path()], y, np.ones(y.size)), KEPT, GRID, LEAST)
    x, grid = polish.follow(row(Stages()))
    assert grid.thresholds[1] == pytest.approx(TRUE_R, abs=0.02)
    assert x == pytest.approx(row(Stages()))  # nothing follows from them here, so they stay
    before, after = (
        np.std(solve(table([path()], KEPT, each), y, each, LEAST, np.ones(y.size)).errors_um)
        for each in (GRID, grid)
    )
    assert after < 0.3 * before


def test_thresholds_stay_in_order() -> None:
    """Whatever would be best: none goes halfway to its neighbour."""
    y = np.asarray(table([path()], KEPT, GRID)[:, 5:10].sum(axis=1) + 4.0 * np.sign(path()))
    polish = Polish(lambda _: Bare([path()], y, np.ones(y.size)), KEPT, GRID, LEAST)
    _, grid = polish.follow(row(Stages()))
    assert grid.thresholds[0] == 0.0
    assert (np.abs(grid.thresholds - GRID.thresholds) <= ROOM * 0.7 + 1e-9).all()


def test_a_stage_is_found_with_the_weights_free() -> None:
    """The field's path is larger by what one stage is away from where it should be."""
    y, first = displacement_um(), row(Stages())

    def rows_of(stages: F64) -> Bare:
        bent = path() + 0.4 * (stages[0] - 0.16) / row(STEP)[0] * np.sin(np.arange(900) / 40.0)
        return Bare([np.ascontiguousarray(bent)], y, np.ones(y.size))

    x, _ = Polish(rows_of, KEPT, GRID, LEAST).follow(first)
    assert x[0] == pytest.approx(0.16, abs=0.002)
    assert (x >= row(LOW)).all()
    assert (x <= row(HIGH)).all()
    assert x.size == STAGES


@pytest.mark.parametrize("lengths", [(), (0.6, 1.5)])
def test_operators_of_known_weights_give_what_their_columns_do(lengths: tuple[float, ...]) -> None:
    grid = replace(GRID, lengths=np.array(lengths))
    slopes = np.random.default_rng(3).uniform(0.5, 2.0, (grid.lines, 5))
    for gain in (1.0, 2.0):  # within the cells, and beyond them
        given, _ = outputs([path(gain)] * 2, KEPT * 2, grid, slopes)
        columns = table([path(gain)] * 2, KEPT * 2, grid)
        assert given == pytest.approx(columns @ slopes.ravel(), abs=1e-9)


def test_slopes_by_thresholds_are_differences() -> None:
    slopes = np.random.default_rng(3).uniform(0.5, 2.0, (3, 5))
    _, found = outputs([path()], KEPT, GRID, slopes)
    for i in (1, 2):
        moved = []
        for change in (-1e-3, 1e-3):
            thresholds = GRID.thresholds.copy()
            thresholds[i] += change
            grid = replace(GRID, thresholds=thresholds)
            moved.append(table([path()], KEPT, grid) @ slopes.ravel())
        rise = (moved[1] - moved[0]) / 2e-3
        assert np.mean(np.abs(found[:, i - 1] - rise)) < 0.05 * np.mean(np.abs(rise))


def test_what_free_weights_take_up_of_a_change_costs_nothing() -> None:
    """A change along a column of a free weight leaves the sum as it is; another one does not."""
    y = displacement_um() + np.random.default_rng(1).normal(0.0, 0.05, 900)
    columns = table([path()], KEPT, GRID)
    equations = Equations(columns, y, GRID, LEAST, np.ones(900))
    weights = equations.solve()
    here = weights.errors_of(columns @ weights.slopes.ravel(), y)
    changes = np.stack([columns[:, 2], np.sign(path())], axis=1)
    place = equations.place(here, changes)
    total = np.sum((changes - changes.mean(axis=0)) ** 2, axis=0)
    assert place.normal[0, 0] < 1e-2 * total[0]
    assert place.normal[1, 1] > 0.05 * total[1]
    assert place.squares == pytest.approx(equations.solve().squares, rel=0.1)
