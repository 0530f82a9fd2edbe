"""What an emulated Modbus device refuses."""

import pytest

from hilctl_drivers.emulator.modbus_device import EmulatedWatchdog
from hilctl_drivers.emulator.registers import RegisterMap
from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.profile import load_profile
from tests.unit.drivers.emulator.conftest import emulated_modbus


@pytest.mark.parametrize(("name", "output", "sensor", "more", "current_a", "value"), [
    ("labjack_t7", "DAC1", "AIN0", {}, -10.0, 0.0),
    ("labjack_t8", "DAC0", "AIN0", {}, -9.80198, 0.0),
    ("labjack_t7", "DAC0", "AIN0", {"current_a": 2.0}, 2.0, 3.0),
    ("generic_float32", "OUT", "IN", {}, 0.0, 0.0),
    ("adam_6024", "AO0", "AI0", {}, 0.0, 5.0),
])  # fmt: skip
def test_powers_up_as_its_profile_says(name, output, sensor, more, current_a, value):
    device = emulated_modbus(name, output, sensor, **more)
    assert device._rig.command == pytest.approx(current_a, abs=5e-3)
    assert device._outputs[output].value == pytest.approx(value, abs=2e-3)


def test_trip_that_a_step_clears_keeps_the_command():
    device = emulated_modbus("wago_750", "AO0", "AI0")
    device.write("holding", 0, b"\x40\0")
    device._watchdog.armed = device._watchdog.tripped = True
    device._trip(0)
    assert device._rig.command == 0.0
    assert device._outputs["AO0"].data == b"\x40\0"
    with pytest.raises(RejectedRequest):
        device.write("holding", 0, b"\0\x64")
    device.write("holding", 0x1007, b"\0\1")
    assert not device.tripped
    assert device._rig.command == 0.0
    device.write("holding", 0, b"\0\x64")
    assert device._rig.command == pytest.approx(100 * 10 / 32767)


S = 1_000_000_000


class Registers:
    """A T7's watchdog and registers; writes go through both, as a device's do."""

    def __init__(self):
        profile = load_profile("labjack_t7")
        self.map = RegisterMap(profile)
        self.watchdog = EmulatedWatchdog(profile.watchdog, self.map.steps)

    def write(self, address, value, now_ns):
        ((target, given),) = self.map.targets("holding", address, value.to_bytes(4, "big"))
        target.data = given
        self.watchdog.written(target, now_ns)


@pytest.fixture
def armed():
    """Armed at 10 s with a timeout of 3 s."""
    made = Registers()
    made.write(61604, 3, 9 * S)
    made.write(61600, 1, 10 * S)
    return made


def test_any_request_feeds_it_and_ends_a_trip(armed):
    armed.watchdog.request(12 * S)
    assert armed.watchdog.due_ns == 15 * S
    armed.watchdog.tripped = True
    assert armed.watchdog.due_ns is None
    armed.watchdog.request(20 * S)
    assert not armed.watchdog.tripped
    assert armed.watchdog.due_ns == 23 * S


def test_a_write_of_zero_disarms_it(armed):
    armed.write(61600, 0, 11 * S)
    assert armed.watchdog.due_ns is None
