"""The limits of a command: nothing gets past them, and nothing else is touched."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.kernels.limit import limit_block

LOW, HIGH, STEP = -1.5, 2.0, 0.25
RANGE, SLEW, INVALID = 1, 2, 4
ANY_FLOAT = st.floats(width=64)
WIDE = {"min_value": -1e6, "max_value": 1e6}


def limited(wanted, previous=0.0, low=LOW, high=HIGH, max_step=STEP):
    wanted = np.asarray(wanted, dtype=np.float64)
    command, flags = np.full(wanted.size, np.nan), np.zeros(wanted.size, dtype=np.uint32)
    limit_block(wanted, previous, low, high, max_step, RANGE, SLEW, INVALID, command, flags)
    return command, flags


def reference(wanted, previous, low, high, max_step):
    """The rules in the order they are stated: finite, range, slew."""
    last, commands, flags = previous, [], []
    for wish in wanted:
        flag = 0 if math.isfinite(wish) else INVALID
        value = wish if math.isfinite(wish) else last
        if not low <= value <= high:
            flag |= RANGE
            value = min(high, max(low, value))
        if not last - max_step <= value <= last + max_step:
            flag |= SLEW
            value = last + math.copysign(max_step, value - last)
        last = value
        commands.append(value)
        flags.append(flag)
    return commands, flags


@pytest.mark.parametrize("max_step", [STEP, 100.0])
def test_sweep_beyond_both_ends(max_step):
    up = np.linspace(-4.0, 4.0, 200)
    wanted = np.concatenate((up, up[::-1], [0.0, HIGH, LOW, 0.0]))
    command, flags = limited(wanted, max_step=max_step)
    expected, expected_flags = reference(wanted.tolist(), 0.0, LOW, HIGH, max_step)
    np.testing.assert_array_equal(command, expected)
    np.testing.assert_array_equal(flags, expected_flags)
    assert command.max() == HIGH
    assert command.min() == LOW


@pytest.mark.parametrize("wanted", [LOW, HIGH, 0.0, -0.0, np.nextafter(HIGH, 0), 5e-324])
def test_inactive_limits_pass_the_bits(wanted):
    command, flags = limited([wanted], max_step=100.0)
    assert command.tobytes() == np.array([wanted]).tobytes()
    assert flags[0] == 0


@pytest.mark.parametrize("wish", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_holds_the_last_command(wish):
    command, flags = limited([0.1, wish, wish, 0.2])
    assert command.tolist() == [0.1, 0.1, 0.1, 0.2]
    assert flags.tolist() == [0, INVALID, INVALID, 0]


def test_a_jump_is_walked_in_steps():
    command, flags = limited([1.0] * 6)
    assert command.tolist() == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    assert flags.tolist() == [SLEW, SLEW, SLEW, 0, 0, 0]


def test_flags_are_added_to_what_is_there():
    wanted = np.array([0.1, np.nan, 9.0, -9.0, 1.0])
    command, flags = np.empty(5), np.full(5, 64, dtype=np.uint32)
    limit_block(wanted, 0.0, LOW, HIGH, 2.0, RANGE, SLEW, INVALID, command, flags)
    assert command.tolist() == [0.1, 0.1, 2.0, 0.0, 1.0]
    assert flags.tolist() == [64, 64 | INVALID, 64 | RANGE, 64 | RANGE | SLEW, 64]


@st.composite
def limits(draw):
    """A range, a largest step, and a previous command within the range."""
    low, high = sorted(draw(st.floats(**WIDE)) + 0.0 for _ in range(2))  # no -0.0 above 0.0
    max_step = draw(st.floats(1e-9, 1e7))
    return draw(st.floats(low, high)), low, high, max_step


@given(limits(), st.lists(ANY_FLOAT, max_size=60))
def test_nothing_gets_past(settings, wanted):
    previous, low, high, max_step = settings
    command, flags = limited(wanted, previous, low, high, max_step)
    assert np.all((command >= low) & (command <= high))
    before = np.concatenate(([previous], command))[:-1]
    rounding = np.spacing(np.maximum(np.abs(before), np.abs(command)))
    assert np.all(np.abs(command - before) <= max_step + rounding)
    touched = command.view(np.uint64) != np.array(wanted, dtype=np.float64).view(np.uint64)
    np.testing.assert_array_equal(flags != 0, touched)


@given(limits(), st.lists(ANY_FLOAT, max_size=40))
def test_follows_the_stated_rules(settings, wanted):
    command, flags = limited(wanted, *settings)
    expected, expected_flags = reference(wanted, *settings)
    np.testing.assert_array_equal(command, expected)
    np.testing.assert_array_equal(flags, expected_flags)


@given(limits(), st.lists(ANY_FLOAT, max_size=40), st.integers(0, 40))
def test_any_cut_gives_the_same_commands(settings, wanted, cut):
    previous, *rest = settings
    whole, flags = limited(wanted, previous, *rest)
    first, first_flags = limited(wanted[:cut], previous, *rest)
    last = float(first[-1]) if first.size else previous
    second, second_flags = limited(wanted[cut:], last, *rest)
    assert np.concatenate((first, second)).tobytes() == whole.tobytes()
    np.testing.assert_array_equal(np.concatenate((first_flags, second_flags)), flags)
