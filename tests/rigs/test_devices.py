"""The device contract, for the rigs of other physics."""

from pkgutil import resolve_name

import numpy as np
import pytest

from hilctl_drivers.contract import *  # noqa: F403  the checks, and the fixture driven
from hilctl_drivers.contract import RATE_HZ, SAMPLES, DrivenDevice
from tests.rigs import DEVICES
from tests.rigs.devices import SimulatedThermalSwitching, SwitchingOptions
from tests.unit.drivers.simulated.test_actuator_base import run


@pytest.fixture(params=DEVICES)
def case(request):
    return request.param


@pytest.fixture
def make():
    """Return a factory of devices, which are closed afterwards."""
    made = []

    def of(case):
        chosen = resolve_name(DEVICES[case])
        device = chosen(chosen.Options())
        made.append(device)
        return DrivenDevice(
            device, SAMPLES, RATE_HZ, lambda: device.last_command, starts_at_rest=True
        )

    yield of
    for device in made:
        device.close()


def test_the_stack_rests_at_0_and_says_what_it_was():
    device = SimulatedThermalSwitching(SwitchingOptions(noise=False))
    assert not run(device.plant(1e3), np.zeros(500)).any()
    assert device.info.details["thermal_v"] == "1.0"
