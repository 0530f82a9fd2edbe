"""What an emulated Modbus device refuses."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.modbus_device import Declined, EmulatedModbus
from hilctl_drivers.emulator.rig import Rig, WriteLog
from hilctl_drivers.profile import load_profile


def device_of(name: str, output: str, sensor: str) -> EmulatedModbus:
    return EmulatedModbus(load_profile(name), Rig(0), WriteLog(None, 0), output, sensor)


def test_unknown_channels_are_refused():
    """The message says which there are."""
    with pytest.raises(InputError, match="DAC9 and AIN0: outputs DAC0, DAC1"):
        device_of("labjack_t7", "DAC9", "AIN0")


def test_decline_carries_the_code():
    """What a device declines becomes that exception reply."""
    device = device_of("labjack_t7", "DAC0", "AIN0")
    with pytest.raises(Declined) as declined:
        device.read(["holding"], 9999, 1)
    assert declined.value.code == 2
