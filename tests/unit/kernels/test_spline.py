"""The spline against SciPy's."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from hilctl.kernels.spline import cubic_spline


@pytest.mark.parametrize("size", [2, 3, 4, 5, 50, 2000])
def test_equals_the_not_a_knot_spline(size):
    rng = np.random.default_rng(size)
    values, at = rng.normal(size=size), np.sort(rng.uniform(0.0, size - 1, 500))
    at[[0, -1]] = 0.0, size - 1
    found = np.empty(at.size)
    assert cubic_spline(values, at, np.empty(size), np.empty(size), found) == at.size
    expected = CubicSpline(np.arange(size), values)(at)
    assert np.allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())
