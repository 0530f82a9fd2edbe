"""Operators one after another, and the weights that smooth."""

import numpy as np

from hilctl.models.chain import smoothing_weights


def test_weights_add_up_and_follow_slope_and_bend():
    """Constant, ramp and parabola come out as their derivatives say, whatever the width."""
    k = np.arange(400.0)
    for width in (0.0, 0.4, 3.6, 30.0, 1e6):
        weights, m = smoothing_weights(width, 2.0, 5.0)
        assert weights.size == 2 * m + 1 <= 255
        for y, expected in (
            (np.ones(400), np.ones(400)),
            (k, k + 2.0),
            (k**2, k**2 + 2.0 * 2.0 * k + 5.0 * 2.0),
        ):
            out = np.convolve(y, weights[::-1], "valid")
            np.testing.assert_allclose(out, expected[m : 400 - m], rtol=1e-10)
