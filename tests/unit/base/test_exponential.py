"""The exponential of a matrix, against SciPy's and what is known of it."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from hilctl.base.exponential import exponential


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize("scale", [1e-9, 0.1, 1.0, 30.0])
def test_it_is_scipy_s(size, scale):
    rng = np.random.default_rng(size)
    matrix = scale * (rng.standard_normal((size, size)) - np.eye(size))
    wanted = expm(matrix)
    np.testing.assert_allclose(
        exponential(matrix), wanted, rtol=0.0, atol=1e-12 * np.abs(wanted).max()
    )


def test_nothing_is_one_and_a_turn_turns():
    np.testing.assert_array_equal(exponential(np.zeros((2, 2))), np.eye(2))
    turned = exponential(np.array([[0.0, -1.0], [1.0, 0.0]]) * math.pi / 3.0)
    half, side = 0.5, math.sqrt(0.75)
    np.testing.assert_allclose(turned, [[half, -side], [side, half]], rtol=1e-14)


def test_a_stiff_one_that_is_damped_dies_away():
    """As a structure that is much faster than the samples."""
    stiff = 1e6 * np.array([[0.0, 1.0], [-1.0, -0.2]])
    np.testing.assert_allclose(exponential(stiff), 0.0, atol=1e-12)
