"""What the fit takes plays and drags for is what the model makes of them."""

import numpy as np
import pytest

from hilctl.identify.field.columns import turning_points
from hilctl.identify.field.weights import Grid, table
from hilctl.models.field import FieldModel, OutputCurve

GRID = Grid(np.array([0.0, 0.7, 2.0]), np.array([0.6, 2.5]), -6.0, 3.0, 4, 2)
SLOPES = np.array(
    [[2.0, 2.5, 3.0, 2.0], [0.5, 1.0, 1.0, 0.0], [0.0, 1.0, 2.0, 1.0], [1.0, 2.0, 2.0, 1.0],
     [0.5, 3.0, 0.0, 1.0]]
)  # fmt: skip


def path() -> np.ndarray:
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 1.0, 600)
    return 1.6 * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (3.0, 7.0, 11.0)) * t


def test_columns_times_slopes_are_the_model() -> None:
    u = np.ascontiguousarray(path())
    line = OutputCurve(operators_um=(-1.0, 1.0), displacement_um=(-1.0, 1.0))
    model = FieldModel(
        thresholds=tuple(GRID.thresholds), lengths=tuple(GRID.lengths), lowest=GRID.lowest,
        cell=GRID.width, slopes=tuple(map(tuple, SLOPES.tolist())), curve=line,
    )  # fmt: skip
    # Without losses the field is the mean of the command over a sample: so feed what gives u.
    command = np.empty_like(u)
    before = u[0]
    for k, now in enumerate(u):
        command[k] = 0.5 * (now + before)
        before = now
    modelled = model.forward(1.0).process(command)
    rows = np.arange(u.size)
    columns = table([u], [rows], GRID)
    given = columns @ SLOPES.ravel()
    assert given - given[0] == pytest.approx(modelled - modelled[0], abs=1e-4)


def test_turning_points_and_rows_are_enough_of_a_path() -> None:
    u = np.ascontiguousarray(path())
    kept = np.empty(u.size, dtype=np.int64)
    kept = kept[: turning_points(u, 1.5, kept)].copy()
    assert kept.size < u.size / 5
    whole = table([u], [kept], GRID)
    few = table([np.ascontiguousarray(u[kept])], [np.arange(kept.size)], GRID)
    assert few == pytest.approx(whole, abs=0.02)
