"""The kernels around the rods, each on its own, against what can be worked out by hand."""

import math

import numpy as np
import pytest

from hilctl_drivers.simulated.terfenol_kernel import amplify, creep, respond, warm

CODE_A = 1e-3
NO_LIMIT = math.inf


def amplified(command, left=0.5, decay=0.9, most=NO_LIMIT, substeps=2):
    """Return readings and the currents of all half steps, from 0 A."""
    command = np.asarray(command, dtype=float)
    read, halves = np.empty(command.size), np.empty(2 * command.size * substeps + 1)
    factors = (math.sqrt(left), left, math.sqrt(decay), decay, most, CODE_A)
    amplify(command, read, halves, np.zeros(1), factors, substeps)
    return read, halves


def test_the_current_follows_by_first_order():
    """Half of what is missing is left after each step, and a reading comes before its command."""
    read, halves = amplified([1.0, 1.0])
    assert halves[::2] == pytest.approx(1.0 - 0.5 ** np.arange(5))
    assert halves[1] == pytest.approx(1.0 - math.sqrt(0.5))
    assert read.tolist() == [0.0, 0.75]


def test_commands_and_readings_are_whole_codes():
    read, halves = amplified([0.00149, 0.00151], left=0.0)
    assert halves[[2, -1]] == pytest.approx([0.001, 0.002])
    assert read[1] == pytest.approx(0.001)


def test_no_current_rises_faster_than_the_voltage_drives_it():
    """From rest the largest voltage takes it towards the current that it holds, and no further."""
    _, halves = amplified([10.0] * 40, left=0.0, most=4.0)
    steps = np.arange(81)
    assert halves[::2] == pytest.approx(4.0 * (1.0 - 0.9**steps))
    _, free = amplified([0.3], left=0.0, most=4.0)
    assert free[-1] == pytest.approx(0.3)


def test_creep_comes_to_its_share_of_the_displacement():
    """Each element by its own time constant, and each block goes on where the last one ended."""
    elements = np.array([[0.1, 0.2], [0.5, 0.001], [0.0, 0.0]])
    free = np.full(3, 12.0)
    creep(free, elements, 2.0)
    assert free == pytest.approx(12.0 + 1.0 * (1.0 - 0.5 ** np.arange(1, 4)), abs=0.01)
    longer = np.full(30_000, 12.0)
    creep(longer, elements, 2.0)
    assert longer[-1] == pytest.approx(12.0 + 10.0 * (0.1 + 0.2))


def test_rods_warm_with_the_square_of_the_current():
    """They stand where the room puts them at first, and end at the steady rise."""
    halves, growth, state = np.full(2 * 20_000 + 1, 2.0), np.zeros(10_000), np.zeros(1)
    warm(halves, growth, state, (0.5, 0.01, 3.0, -4.0, 1.0), 2)
    assert growth[0] == pytest.approx(3.0 * -4.0)
    assert growth[-1] == pytest.approx(3.0 * (-4.0 + 0.5 * 3.0**2))
    assert state[0] == pytest.approx(4.5)


def test_a_reading_shows_what_was_before_its_step_and_ends_at_the_range():
    """A structure that follows at once: the reading is the displacement one sample before."""
    motion = np.array([[0.0, 0, 0, 0, 1.0], [0.0] * 5, [0.0, 0, 0, 0, 1.0]])
    free, shown = np.array([3.0, 5.04, 99.0, 0.0]), np.empty(4)
    respond(free, np.zeros(4), shown, np.zeros(5), motion, 1.0, (0.1, 50.0), 1)
    assert shown == pytest.approx([0.0, 2.0, 4.0, 50.0])
