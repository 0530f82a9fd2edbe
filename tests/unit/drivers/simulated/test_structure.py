"""Structure and sensor of the simulated actuators."""

import numpy as np
import pytest

from hilctl_drivers.simulated.actuator_base import read_sensor
from hilctl_drivers.simulated.structure import respond


def test_a_reading_shows_what_was_before_its_step_and_ends_at_the_range():
    """A structure that follows at once: the reading is the displacement one sample before."""
    motion = np.array([[0.0, 0, 0, 0, 1.0], [0.0] * 5, [0.0, 0, 0, 0, 1.0]])
    free, shown = np.array([3.0, 5.04, 99.0, 0.0]), np.empty(4)
    signal = np.empty(4)
    respond(free, signal, np.zeros(5), motion, 1.0, 1)
    read_sensor(signal, np.zeros(4), shown, (0.1, 50.0))
    assert shown == pytest.approx([0.0, 2.0, 4.0, 50.0])
