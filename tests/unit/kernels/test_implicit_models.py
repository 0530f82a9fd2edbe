"""Models whose inverse is a root: exact steps, and a search that never leaves its span."""

import numpy as np
import pytest

from hilctl.kernels.hysteresis import rest_memory
from hilctl.kernels.implicit_models import (
    BOUC_WEN,
    PREISACH,
    bouc_wen_step,
    implicit_forward,
    implicit_inverse,
)

NOTHING = np.zeros(0)
SPAN = (-7.0, 8.0)


def arrays(exponent):
    return np.array([8.0, 2.0, 0.7, -0.2, exponent]), NOTHING, NOTHING


@pytest.mark.parametrize("exponent", [1.0, 2.0])
@pytest.mark.parametrize("change", [3.0, -3.0])
@pytest.mark.parametrize("z", [-0.8, 0.0, 0.8])
def test_a_large_step_is_the_same_as_many_small_ones(exponent, change, z):
    small = z
    for _ in range(1000):
        small = bouc_wen_step(small, change / 1000.0, 0.7, -0.2, exponent)
    assert bouc_wen_step(z, change, 0.7, -0.2, exponent) == pytest.approx(small, abs=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_z_stays_bounded(exponent):
    """However far the command goes: (beta + gamma)^(-1/n)."""
    bound = 0.5 ** (-1.0 / exponent)
    assert bouc_wen_step(0.0, 1e6, 0.7, -0.2, exponent) == pytest.approx(bound, rel=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_the_root_meets_the_displacement_within_its_tolerance(exponent):
    wanted = 30.0 * np.sin(np.arange(400) / 25.0)
    command, back = np.empty(400), np.empty(400)
    implicit_inverse(wanted, BOUC_WEN, arrays(exponent), SPAN, 1e-6, rest_memory(1), command)
    implicit_forward(command, BOUC_WEN, arrays(exponent), rest_memory(1), back)
    assert np.abs(back - wanted).max() <= 1e-6


def test_what_can_not_be_reached_ends_at_the_span_and_nan_leaves_no_trace():
    wanted = np.array([1e3, 5.0, np.nan, 4.0, -1e3])
    command, without = np.empty(5), np.empty(4)
    implicit_inverse(wanted, BOUC_WEN, arrays(1.0), SPAN, 1e-6, rest_memory(1), command)
    kept = wanted[[0, 1, 3, 4]].copy()
    implicit_inverse(kept, BOUC_WEN, arrays(1.0), SPAN, 1e-6, rest_memory(1), without)
    assert np.isnan(command[2])
    np.testing.assert_array_equal(command[[0, 1, 3, 4]], without)
    assert (command[0], command[4]) == (8.0, -7.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300, -1e300])
def test_no_number_leads_out_of_the_cells(wrong):
    preisach = np.array([0.0, 0.5]), np.arange(8.0), np.array([-1.0, 1.0, 3.0])
    for memory in (np.full(3, wrong), rest_memory(2)):
        out = np.zeros(2)
        implicit_forward(np.array([wrong, 0.5]), PREISACH, preisach, memory, out)
        assert not np.isfinite(wrong) or np.sign(out[0]) == np.sign(wrong)
        assert np.isnan(out[1]) or -10.0 < out[1] < 10.0 or abs(wrong) >= 1e300


@pytest.mark.timeout(20)
def test_a_span_of_nearly_nothing_has_an_end():
    out = np.empty(1)
    implicit_inverse(np.ones(1), BOUC_WEN, arrays(1.0), (0.0, 5e-324), 1e-7, rest_memory(1), out)
    assert 0.0 <= out[0] <= 5e-324
