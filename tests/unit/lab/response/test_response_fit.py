"""Gain, delay, lag and modes of known responses."""

import numpy as np
import pytest

from hilctl.lab.response.response_fit import fitted_fields
from hilctl.models.linear_stages import FurtherMode, second_order

RATE_HZ = 20_000.0
HZ = np.arange(10.0, 1600.0, 40.0)
MODE = FurtherMode(
    natural_hz=1100.0,
    damping_ratio=0.02,
    antiresonance_hz=900.0,
    antiresonance_damping_ratio=0.03,
)
LAGGING = -4.0 * np.exp(-2j * np.pi * HZ * 2e-4) / (1.0 + 2j * np.pi * HZ * 3e-4)
RESONANT = LAGGING / second_order(HZ, 600.0, 0.08)


@pytest.mark.parametrize(
    ("response", "natural_hz", "further"),
    [(LAGGING, None, 0), (RESONANT, 600.0, 0), (RESONANT * MODE.response(HZ), 600.0, 1)],
    ids=["lag", "resonance", "two modes"],
)
def test_as_many_modes_as_there_are(response, natural_hz, further):
    found = fitted_fields(HZ, response, np.full(HZ.size, 1e-3), RATE_HZ, held=False)
    np.testing.assert_allclose(found["fitted"], response, rtol=0.01)
    assert found["gain_um"] == pytest.approx(-4.0, rel=1e-3)
    assert found["delay_s"] == pytest.approx(2e-4, rel=0.01)
    assert found["lag_s"] == pytest.approx(3e-4, rel=0.01)
    assert found["natural_hz"] == (natural_hz and pytest.approx(natural_hz, rel=1e-3))
    assert len(found["further"]) == further
    for mode in found["further"]:
        assert mode.model_dump() == pytest.approx(MODE.model_dump(), rel=0.01)


def test_harmonics_at_weak_lines_do_not_move_a_mode():
    """A hysteresis spreads 0.5 % of the resonance over all lines, far above their noise."""
    hz = np.arange(40.0, 6000.0, 40.0)
    response = 1.0 / second_order(hz, 600.0, 0.03)
    phase = np.random.default_rng(3).uniform(0.0, 2.0 * np.pi, hz.size)
    response += 5e-3 * np.abs(response).max() * np.exp(1j * phase)
    found = fitted_fields(hz, response, np.full(hz.size, 1e-4), RATE_HZ, held=False)
    assert found["natural_hz"] == pytest.approx(600.0, rel=0.002)
    assert found["damping_ratio"] == pytest.approx(0.03, rel=0.05)
    assert found["further"] == ()


def test_two_close_modes_are_not_one_of_large_damping():
    """The slower one is the first; together they are parallel modes of 0.7 and 0.3."""
    hz = np.arange(50.0, 4000.0, 50.0)
    response = 0.7 / second_order(hz, 760.0, 0.03) + 0.3 / second_order(hz, 930.0, 0.03)
    response = response * np.exp(-2j * np.pi * hz * 4e-5)
    found = fitted_fields(hz, response, np.full(hz.size, 1e-4), RATE_HZ, held=False)
    assert (found["natural_hz"], found["damping_ratio"]) == pytest.approx((760.0, 0.03), rel=0.01)
    (other,) = found["further"]
    assert (other.natural_hz, other.damping_ratio) == pytest.approx((930.0, 0.03), rel=0.01)
    assert 760.0 < other.antiresonance_hz < 930.0
    assert found["errors"]["natural_hz"] < 1.0


def test_no_mode_beyond_the_lines():
    """A mode that is added may move an earlier one there."""
    hz = np.arange(20.0, 201.0, 20.0)
    response = np.exp(-2j * np.pi * hz * 1.5e-3 - 0.1j) / (1.0 + 2j * np.pi * hz * 3e-3)
    response /= second_order(hz, 300.0, 0.02)
    found = fitted_fields(hz, response, np.full(hz.size, 1e-4), 1000.0, held=False)
    assert found["natural_hz"] is None or found["natural_hz"] < hz[-1]
