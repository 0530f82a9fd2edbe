"""The simulated rig behind an emulated device, with the time in the test's hand."""

import numpy as np
import pytest

from hilctl_drivers.emulator.rig import RATE_HZ, Rig
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

MS = 1_000_000


def test_is_the_actuator_on_its_own_clock():
    """Asked at odd times, it shows the samples of an undisturbed run, noise included."""
    rig = Rig(5 * MS)
    rig.put_out(3.0, 5 * MS)
    shown = []
    for k in range(1, 200):
        rig.advance(5 * MS + k * 137_000)
        shown.append(rig.displacement_um)
    plant = TerfenolActuator(TerfenolParameters(), RATE_HZ)
    command = np.concatenate([np.zeros(1), np.full(400, 3.0)])
    read = np.empty((2, command.size))
    plant.step(command, read[0], read[1])
    due = [int(k * 137_000 * 1e-9 * RATE_HZ) for k in range(1, 200)]
    assert shown == [read[0, max(0, k - 1)] for k in due]


def test_time_does_not_go_back():
    """Being asked twice for the same moment changes nothing."""
    rig = Rig(0)
    rig.put_out(2.0, MS)
    rig.advance(2 * MS)
    before = rig.displacement_um
    rig.advance(2 * MS)
    rig.advance(MS)
    assert rig.displacement_um == before


def test_long_silence_costs_no_more_than_settling():
    """After hours the rig has settled, and is not simulated through all of them."""
    rig = Rig(0, noise=False)
    rig.put_out(2.0, 0)
    rig.advance(24 * 3600 * 1000 * MS)
    settled = rig.displacement_um
    rig.advance(25 * 3600 * 1000 * MS)
    assert rig.displacement_um == pytest.approx(settled, abs=1e-2)


def test_amplifier_saturates():
    """Beyond its range the amplifier gives what it can, as amplifiers do."""
    rig = Rig(0)
    rig.put_out(50.0, 0)
    assert rig.current_a == 10.0
