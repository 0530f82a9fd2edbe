"""The Krasnosel'skii-Pokrovskii model against its definition."""

import numpy as np

from hilctl.models.kp import KrasnoselskiiPokrovskiiModel

RATE_HZ = 50_000.0
LOW, HIGH = SPAN = (-7.0, 8.0)
PLAIN = {"command_span": SPAN}
KP = KrasnoselskiiPokrovskiiModel(
    **PLAIN, lowest=-4.0, spacing=2.0, weights=((1.0,), (0.5, 2.0), (0.0, 3.0, 0.5))
)


def test_kp_follows_its_definition():
    """Each operator obeys (1.4), which tells rising from falling commands."""
    v = np.array([0.0, 1.0, 3.0, 0.5, 0.2, -3.3, -1.0, 1.7, 1.7, -0.3, 4.0, -4.5])

    def ridge(x):
        return float(np.clip(-1.0 + 2.0 * x / KP.spacing, -1.0, 1.0))

    expected = np.zeros(v.size)
    for i, row in enumerate(KP.weights):
        for j, weight in enumerate(row):
            alpha, beta = KP.lowest + KP.spacing * np.array([i, j])
            held = max(ridge(-alpha), min(ridge(-beta), 0.0))
            for k in range(v.size):
                if k and v[k] > v[k - 1]:
                    held = max(held, ridge(v[k] - alpha))
                elif k and v[k] < v[k - 1]:
                    held = min(held, ridge(v[k] - beta))
                expected[k] += weight * held
    np.testing.assert_allclose(KP.forward(RATE_HZ).process(v), expected, atol=1e-12)
