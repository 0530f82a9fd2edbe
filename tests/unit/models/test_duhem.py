"""The Duhem model against a general solver of its equation."""

import itertools

import numpy as np
from scipy.integrate import solve_ivp

from hilctl.models.duhem import DuhemModel

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
PLAIN = {"command_span": SPAN}
DUHEM = DuhemModel(**PLAIN, a=0.5, b=8.0, c=5.0)


def test_duhem_solves_its_equation():
    """Between samples the displacement is what a solver makes of (1.22)."""
    v = np.array([0.0, 4.0, -1.0, 0.5, -5.0, 6.0, -6.0])
    y, expected = 0.0, [0.0]
    for begin, end in itertools.pairwise(v):
        rate = end - begin

        def slope(time, y, begin=begin, rate=rate):
            command = begin + rate * time
            return DUHEM.a * abs(rate) * (DUHEM.b * command - y) + DUHEM.c * rate

        y = solve_ivp(slope, (0.0, 1.0), [y], rtol=1e-10, atol=1e-12).y[0, -1]
        expected.append(y)
    np.testing.assert_allclose(DUHEM.forward(RATE_HZ).process(v), expected, atol=1e-6)
