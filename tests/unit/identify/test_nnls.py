"""Densities that the data leave open are held, and those that they give are found."""

import numpy as np

from hilctl.identify.nnls import numbered, smooth_densities

RNG = np.random.default_rng(6)


def test_what_the_data_leave_open_is_shared_evenly() -> None:
    """Of two columns that are one, each has half: least squares alone could say anything."""
    column = RNG.normal(size=200)
    columns = np.stack([column, column], axis=1)
    table = np.array([[0, 1]])
    found, constant = smooth_densities(
        columns, 3.0 * column + 2.0, np.ones(200), np.zeros(2), table, 0.01
    )
    np.testing.assert_allclose(found, 1.5, rtol=1e-5)
    assert abs(constant - 2.0) < 1e-5


def test_densities_that_the_data_give_are_found() -> None:
    """The hold is weak, lower bounds are kept, and places without a density are left out."""
    columns, truth = RNG.normal(size=(300, 6)), np.array([0.5, 0.0, 2.0, 1.0, 0.3, 0.1])
    table = numbered(np.array([True, True, False, True, True, True, True, False])).reshape(2, 4)
    assert table.tolist() == [[0, 1, -1, 2], [3, 4, 5, -1]]
    least = np.array([0.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    target = columns @ np.maximum(truth, least) - 1.0
    found, constant = smooth_densities(columns, target, np.ones(300), least, table, 0.01)
    np.testing.assert_allclose(found, np.maximum(truth, least), atol=1e-3)
    assert found[4] >= 0.4
    assert abs(constant + 1.0) < 1e-3
