"""The interlocks as one compiled call: bits of the compiled form, refused types, empty blocks."""

import math

import numpy as np
import pytest

from hilctl.base.samples import Flag
from hilctl.kernels import interlock as kernels
from hilctl.kernels.interlock import InterlockFlag, heat_block, interlock_block

N = 400
SETTINGS = np.array([-8.0, 8.0, -9.0, 9.0, 0.0, 0.5, 3.0, 0.2, 2.0, 0.01, 1.5, 4.0, 2.0, 1.0])
ALL = Flag.SENSOR_INVALID | (sum(InterlockFlag) - InterlockFlag.AUX - InterlockFlag.APART)


def columns():
    """Return command, reference, displacement and measured with something of everything."""
    generator = np.random.default_rng(4)
    command = 2.0 * np.sin(np.arange(N) / 9.0)
    displacement = 3.0 * np.roll(command, 2) + 0.1 * generator.standard_normal(N)
    displacement[100:140] = displacement[100]
    displacement[[200, 201, 202]] = np.nan, -8.5, 9.0
    displacement[210:213] = np.nan
    reference = 3.0 * command
    reference[250:300] += 5.0
    reference[280:] = np.nan
    measured = np.roll(command, 1)
    measured[320:330] += 0.5
    measured[350:360] = np.nan
    return command, reference, displacement, measured


def fresh_memory():
    memory = np.zeros(kernels.MEMORY)
    memory[kernels.READING] = math.nan
    return memory


def run(kernel, given, memory=None):
    memory = fresh_memory() if memory is None else memory
    flags = np.zeros(given[0].size, dtype=np.uint32)
    first = kernel(SETTINGS, memory, *given, flags)
    return first, memory, flags


@pytest.mark.skipif(not hasattr(interlock_block, "py_func"), reason="compilation is switched off")
def test_compiled_and_python_agree_bit_for_bit():
    first, memory, flags = run(interlock_block, columns())
    plain_first, plain_memory, plain_flags = run(interlock_block.py_func, columns())
    assert first == plain_first
    np.testing.assert_array_equal(memory, plain_memory)
    np.testing.assert_array_equal(flags, plain_flags)
    assert np.bitwise_or.reduce(flags) == ALL  # the signal has something of everything


def test_an_empty_block_changes_nothing():
    _, memory, _ = run(interlock_block, columns())
    before = memory.copy()
    first, memory, _ = run(interlock_block, [np.empty(0)] * 4, memory)
    assert first == -1
    np.testing.assert_array_equal(memory, before)


def test_flags_are_added_to_what_is_there():
    given = columns()
    before = [column.copy() for column in given]
    _, _, expected = run(interlock_block, given)
    flags = np.full(N, Flag.RAMP.value, dtype=np.uint32)
    interlock_block(SETTINGS, fresh_memory(), *given, flags)
    np.testing.assert_array_equal(flags, expected | np.uint32(Flag.RAMP.value))
    for column, old in zip(given, before, strict=True):
        np.testing.assert_array_equal(column, old)


def test_heat_settles_at_the_square_of_a_constant_current():
    """One time constant takes the heat 1 - 1/e of its way, many take it there."""
    heat = np.empty(2000)
    end = heat_block(np.full(2000, -3.0), -math.expm1(-0.01), 0.0, heat)
    assert heat[99] == pytest.approx(9.0 * (1.0 - math.exp(-1.0)), rel=1e-12)
    assert end == heat[-1] == pytest.approx(9.0, rel=1e-8)


def test_heat_cools_from_where_it_was():
    heat = np.empty(100)
    heat_block(np.zeros(100), -math.expm1(-0.01), 4.0, heat)
    np.testing.assert_allclose(heat, 4.0 * np.exp(-0.01 * np.arange(1, 101)), rtol=1e-12)


def test_heat_is_that_of_the_interlock():
    command, reference, displacement, _ = columns()
    heat = np.empty(N)
    end = heat_block(command, SETTINGS[kernels.WARMING], 0.0, heat)
    unmeasured = np.full(N, np.nan)
    _, memory, flags = run(interlock_block, (command, reference, displacement, unmeasured))
    assert memory[kernels.HEAT] == end
    hot = (flags & InterlockFlag.THERMAL) != 0
    np.testing.assert_array_equal(hot, heat > SETTINGS[kernels.BUDGET])
    assert hot.any()
