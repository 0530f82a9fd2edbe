"""The Bouc-Wen model against a general solver of its equation."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hilctl.models.bouc_wen import BoucWenModel

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
PLAIN = {"command_span": SPAN}


@pytest.mark.parametrize("exponent", [1, 2])
@pytest.mark.parametrize("gamma", [-0.2, 0.0, 0.7])
def test_bouc_wen_solves_its_equation(exponent, gamma):
    """Between samples z is what a differential-equation solver makes of (1.21)."""
    model = BoucWenModel(
        **PLAIN, direct=10.0, hysteretic=2.0, beta=0.7, gamma=gamma, exponent=exponent
    )
    v = np.array([0.0, 4.0, -1.0, 0.5, -5.0, 6.0, -6.0])
    z, expected = 0.0, [0.0]
    for begin, end in itertools.pairwise(v):
        rate = end - begin

        def slope(_, z, rate=rate):
            size = np.abs(z)
            return (
                rate - 0.7 * abs(rate) * size ** (exponent - 1) * z - gamma * rate * size**exponent
            )

        z = solve_ivp(slope, (0.0, 1.0), [z], rtol=1e-10, atol=1e-12).y[0, -1]
        expected.append(10.0 * end - 2.0 * z)
    np.testing.assert_allclose(model.forward(RATE_HZ).process(v), expected, atol=1e-6)
