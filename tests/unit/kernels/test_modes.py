"""The kernels of a pair of antiresonance and resonance, against SciPy's own discretisation."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from hilctl.kernels.modes import mode_stage, unmode_stage
from hilctl.models.structure import Mode

RATE_HZ = 20e3
PAIR = Mode(
    natural_hz=900.0, damping_ratio=0.04, antiresonance_hz=760.0, antiresonance_damping_ratio=0.02
)
PARAMETERS = PAIR._parameters(RATE_HZ)


def run(kernel, values, memory=None):
    memory = np.full(3, np.nan) if memory is None else memory
    out = np.empty_like(values)
    kernel(values, PARAMETERS, memory, out)
    return out, memory


@pytest.fixture
def walk():
    return np.cumsum(np.random.default_rng(7).standard_normal(3000))


def test_a_pair_is_what_scipy_makes_of_its_transfer_function(walk):
    up, down = 1.0 / (2.0 * np.pi * 760.0), 1.0 / (2.0 * np.pi * 900.0)
    transfer = [up**2, 2.0 * 0.02 * up, 1.0], [down**2, 2.0 * 0.04 * down, 1.0]
    numerator, denominator, _ = cont2discrete(transfer, 1.0 / RATE_HZ, method="foh")
    wanted = lfilter(numerator[0], denominator, walk - walk[0]) + walk[0]
    out, memory = run(mode_stage, walk)
    np.testing.assert_allclose(out, wanted, rtol=0.0, atol=1e-8)
    assert memory[2] == walk[-1]


def test_undone_to_rounding_from_any_memory(walk):
    memory = np.array([0.3, -0.2, 4.0])
    y, _ = run(mode_stage, walk, memory.copy())
    x, left = run(unmode_stage, y, memory.copy())
    np.testing.assert_allclose(x, walk, rtol=0.0, atol=1e-9)
    assert left[2] == x[-1]


@pytest.mark.parametrize("kernel", [mode_stage, unmode_stage])
def test_any_cut_into_blocks_gives_the_same_bits_and_output_and_input_may_be_one(walk, kernel):
    whole, _ = run(kernel, walk)
    memory, values = np.full(3, np.nan), walk.copy()
    for part in np.split(values, [1, 2, 700, 701]):
        kernel(part, PARAMETERS, memory, part)
    np.testing.assert_array_equal(values, whole)


@pytest.mark.parametrize("kernel", [mode_stage, unmode_stage])
def test_what_never_moved_stays(kernel):
    out, _ = run(kernel, np.full(50, 3.25))
    np.testing.assert_allclose(out, 3.25, rtol=1e-13)


@pytest.mark.parametrize("kernel", [mode_stage, unmode_stage])
def test_it_begins_at_rest_whatever_was_before(kernel):
    out, _ = run(kernel, np.full(50, 3.25), np.array([1.0, 5.0, np.nan]))
    np.testing.assert_allclose(out, 3.25, rtol=1e-13)


@pytest.mark.parametrize("kernel", [mode_stage, unmode_stage])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_displacement_is_forgotten(walk, kernel, bad):
    values = walk.copy()
    values[100] = bad
    with np.errstate(invalid="ignore"):  # of Python, where it is not compiled
        out, _ = run(kernel, values)
    assert not np.isfinite(out[100])
    assert np.isfinite(out[103:]).all()
