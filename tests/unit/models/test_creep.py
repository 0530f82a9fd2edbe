"""Creep: its law, its exact inverse, and what it refuses."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.models.creep import CreepModel

RATE_HZ = 1000.0
CREEP = CreepModel(time_constants_s=(0.05, 2.0), shares=(0.02, 0.04))


def signal(n=4000):
    return np.cumsum(np.random.default_rng(4).standard_normal(n))


def test_a_displacement_that_stays_creeps_on_by_each_share():
    """After a step each element goes after its share by first order."""
    x_um = np.concatenate(([0.0], np.full(20_000, 10.0)))
    time_s = np.arange(x_um.size - 1) / RATE_HZ
    crept = CREEP.forward(RATE_HZ).process(x_um) - x_um
    wanted = 0.2 * -np.expm1(-time_s / 0.05) + 0.4 * -np.expm1(-time_s / 2.0)
    np.testing.assert_allclose(crept[1:], wanted, rtol=0.0, atol=1e-12)


def test_inverse_undoes_creep_exactly():
    x_um = signal()
    y_um = CREEP.forward(RATE_HZ).process(x_um)
    assert np.abs(y_um - x_um).max() > 0.01 * np.ptp(x_um)
    np.testing.assert_allclose(CREEP.inverse(RATE_HZ).process(y_um), x_um, rtol=0.0, atol=1e-10)


def test_any_cut_into_blocks_gives_the_same_bits():
    y_um = signal()
    whole, parts = CREEP.inverse(RATE_HZ), CREEP.inverse(RATE_HZ)
    came = np.concatenate([parts.process(part) for part in np.split(y_um, (1, 2, 40, 1000))])
    np.testing.assert_array_equal(came, whole.process(y_um))


def test_only_what_is_away_from_rest_creeps():
    """A displacement that stands at rest stays there, wherever that is."""
    still = np.full(3000, -7.5)
    for operator in (CREEP.forward(RATE_HZ, rest_um=-7.5), CREEP.inverse(RATE_HZ, rest_um=-7.5)):
        np.testing.assert_array_equal(operator.process(still), still)


def test_a_value_that_is_none_is_not_gone_on_from():
    """It comes out as none; those after it are as good as ever."""
    y_um = np.full(100, 5.0)
    y_um[40] = np.nan
    came = CREEP.inverse(RATE_HZ).process(y_um)
    assert np.isnan(came[40])
    assert np.isfinite(np.delete(came, 40)).all()


@pytest.mark.parametrize(("times_s", "shares", "message"), [
    ((1.0, 0.5), (0.1, 0.1), "T must rise from 0"),
    ((1.0,), (0.1, 0.1), "shares must have one value a time constant: 2 for 1"),
    ((1.0,), (0.0,), "greater than 0"),
    ((1e-5,), (0.1,), "greater than or equal to 0.001"),
    ((), (), "at least 1 item"),
])  # fmt: skip
def test_conditions_are_named(times_s, shares, message):
    with pytest.raises(ValidationError, match=message):
        CreepModel(time_constants_s=times_s, shares=shares)
