"""What compilation must not change: bits, block cuts, types."""

import numba
import numpy as np
import pytest

from hilctl.kernels import hysteresis
from hilctl.kernels.limit import limit_block

PLAYS = (1.3, np.array([0.2, 0.5, 0.9]), np.array([0.7, 0.1, 0.4]))
DEADBANDS = (1.7, np.array([0.4, 1.1]), np.array([-0.2, -0.3]), np.array([-0.3]), np.array([0.25]))
SIGNAL = 2.0 * np.sin(np.arange(400) / 9.0) + 0.6 * np.cos(np.arange(400) / 2.3)
WIDENING = 0.1 + 0.1 * np.sin(np.arange(400) / 5.0)

STREAMING = {
    "play_sum": (hysteresis.play_sum, (0.3, *PLAYS)),
    "play_sum_shared": (hysteresis.play_sum_shared, (WIDENING, *PLAYS)),
    "stop_sum": (hysteresis.stop_sum, PLAYS),
    "integrated_forward": (hysteresis.integrated_forward, (0.3, *PLAYS, *DEADBANDS)),
    "integrated_inverse": (hysteresis.integrated_inverse, (*DEADBANDS, 0.3, *PLAYS)),
}


def stream(kernel, signal, parameters, memory=None):
    memory = hysteresis.rest_memory(3) if memory is None else memory
    out = np.empty_like(signal)
    kernel(signal, *parameters, memory, out)
    return out, memory


@pytest.mark.parametrize("name", STREAMING)
def test_compiled_and_python_agree_bit_for_bit(name):
    """The function as written, run by Python, gives the same bits as its compiled form."""
    kernel, parameters = STREAMING[name]
    compiled, memory = stream(kernel, SIGNAL, parameters)
    plain, plain_memory = stream(kernel.py_func, SIGNAL, parameters)
    np.testing.assert_array_equal(compiled, plain)
    np.testing.assert_array_equal(memory, plain_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_callable_from_another_kernel(name):
    """Called inside somebody else's compiled function, a kernel does the same."""
    kernel, parameters = STREAMING[name]

    @numba.njit
    def caller(signal, parameters, memory, out):
        kernel(signal, *parameters, memory, out)

    expected, _ = stream(kernel, SIGNAL, parameters)
    out = np.empty_like(SIGNAL)
    caller(SIGNAL, parameters, hysteresis.rest_memory(3), out)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("name", STREAMING)
def test_output_may_replace_the_input(name):
    """Writing over the input array changes nothing."""
    kernel, parameters = STREAMING[name]
    expected, expected_memory = stream(kernel, SIGNAL, parameters)
    both, memory = SIGNAL.copy(), hysteresis.rest_memory(3)
    kernel(both, *parameters, memory, both)
    np.testing.assert_array_equal(both, expected)
    np.testing.assert_array_equal(memory, expected_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_an_empty_block_changes_nothing(name):
    """A block of no samples leaves the memory as it is."""
    kernel, parameters = STREAMING[name]
    _, memory = stream(kernel, SIGNAL, parameters)
    before = memory.copy()
    stream(kernel, np.empty(0), parameters, memory)
    np.testing.assert_array_equal(memory, before)


@pytest.mark.parametrize("name", STREAMING)
def test_nan_is_not_swallowed(name):
    """An input that is not a number gives an output that is not one."""
    kernel, parameters = STREAMING[name]
    signal = SIGNAL.copy()
    signal[200] = np.nan
    out, _ = stream(kernel, signal, parameters)
    assert np.all(np.isfinite(out[:200]))
    assert np.isnan(out[200])


@pytest.mark.parametrize("v", [-1.7, -0.2, 0.0, 0.3, 2.0])
def test_scalar_kernels_agree_with_python(v):
    """The scalar operators give Python's bits, alone and inside another compiled function."""
    stop = hysteresis.stop_step
    value = hysteresis.deadband_value

    @numba.njit
    def caller(v, deadbands):
        return stop(v, 0.2, 0.4, 0.1), value(v, *deadbands)

    expected = (
        stop.py_func(v, 0.2, 0.4, 0.1),
        value.py_func(v, *DEADBANDS),
    )
    assert (stop(v, 0.2, 0.4, 0.1), value(v, *DEADBANDS)) == expected
    assert caller(v, DEADBANDS) == expected


@pytest.mark.parametrize("name", STREAMING)
def test_float32_is_refused(name):
    """A float32 array is an error at once, not a new compilation."""
    kernel, parameters = STREAMING[name]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL.astype(np.float32), *parameters, hysteresis.rest_memory(3), SIGNAL.copy())


def test_float32_is_refused_everywhere_else():
    """So it is by the kernels without memory."""
    narrow, out = SIGNAL.astype(np.float32), np.empty(400)
    flags = np.zeros(400, dtype=np.uint32)
    grid, memory = np.empty((400, 3)), hysteresis.rest_memory(3)
    with pytest.raises(TypeError, match="No matching definition"):
        hysteresis.deadband_block(narrow, *DEADBANDS, out)
    with pytest.raises(TypeError, match="No matching definition"):
        hysteresis.play_outputs(narrow, WIDENING, PLAYS[1], memory, grid)
    with pytest.raises(TypeError, match="No matching definition"):
        limit_block(narrow, 0.0, -1.0, 1.0, 0.1, 1, 2, 4, out, flags)


def test_a_strided_view_is_refused():
    """A view that is not contiguous is refused too: it would need another compilation."""
    kernel, parameters = STREAMING["play_sum"]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL[::2], *parameters, hysteresis.rest_memory(3), np.empty(200))
