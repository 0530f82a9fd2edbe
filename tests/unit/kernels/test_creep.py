"""The kernels of creep, against filters of SciPy."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hilctl.kernels.creep import creep_stage, uncreep_stage

LEFT, GAIN = np.array([0.5, 0.9, 0.999]), np.array([0.02, 0.004, 3e-5])
PARAMETERS = np.concatenate((LEFT, GAIN))


def run(kernel, values, memory=None, parameters=PARAMETERS):
    memory = np.array([0.0, 0.0, 0.0, np.nan]) if memory is None else memory
    out = np.empty_like(values)
    kernel(values, parameters, memory, out)
    return out, memory


@pytest.fixture
def walk():
    return np.cumsum(np.random.default_rng(7).standard_normal(3000))


def test_creep_is_a_sum_of_first_order_filters_a_sample_late(walk):
    crept = sum(lfilter([0.0, g], [1.0, -a], walk) for a, g in zip(LEFT, GAIN, strict=True))
    out, memory = run(creep_stage, walk)
    np.testing.assert_allclose(out, walk + crept, rtol=0.0, atol=1e-10)
    assert memory[-1] == walk[-1]


def test_undone_to_rounding_from_any_memory(walk):
    memory = np.array([0.3, -0.2, 0.1, 4.0])
    y, _ = run(creep_stage, walk, memory.copy())
    x, left = run(uncreep_stage, y, memory.copy())
    np.testing.assert_allclose(x, walk, rtol=0.0, atol=1e-10)
    assert left[-1] == x[-1]


def test_output_and_input_may_be_one_array(walk):
    wanted, _ = run(uncreep_stage, walk)
    memory, values = np.array([0.0, 0.0, 0.0, np.nan]), walk.copy()
    uncreep_stage(values, PARAMETERS, memory, values)
    np.testing.assert_array_equal(values, wanted)


@pytest.mark.parametrize("kernel", [creep_stage, uncreep_stage])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_displacement_creeps_nowhere(walk, kernel, bad):
    values = walk.copy()
    values[100] = bad
    out, _ = run(kernel, values)
    assert not np.isfinite(out[100])
    assert np.isfinite(np.delete(out, 100)).all()
