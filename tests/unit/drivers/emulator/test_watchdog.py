"""An emulated host watchdog, driven by its registers, with the time in the test's hand."""

import pytest

from hilctl_drivers.emulator.registers import RegisterMap
from hilctl_drivers.emulator.watchdog import EmulatedWatchdog
from hilctl_drivers.profile import load_profile

S = 1_000_000_000


class Registers:
    """A T7's watchdog and registers; writes go through both, as a device's do."""

    def __init__(self):
        profile = load_profile("labjack_t7")
        self.map = RegisterMap(profile)
        self.watchdog = EmulatedWatchdog(profile.watchdog, self.map.steps)

    def write(self, address, value, now_ns):
        words = [value >> 16, value & 0xFFFF]
        ((target, given),) = self.map.memory.targets("holding", address, words)
        target.words[:] = given
        self.watchdog.written(target, now_ns)


@pytest.fixture
def armed():
    """Armed at 10 s with a timeout of 3 s."""
    made = Registers()
    made.write(61604, 3, 9 * S)
    made.write(61600, 1, 10 * S)
    return made


def test_it_is_off_until_its_last_step_is_written():
    registers = Registers()
    registers.write(61604, 3, 0)
    assert not registers.watchdog.armed
    assert registers.watchdog.due_ns is None
    registers.write(61600, 1, 10 * S)
    assert registers.watchdog.armed
    assert registers.watchdog.timeout_s == 3.0
    assert registers.watchdog.due_ns == 13 * S


def test_any_request_feeds_it(armed):
    armed.watchdog.request(12 * S)
    assert armed.watchdog.due_ns == 15 * S


def test_a_write_of_zero_disarms_it(armed):
    armed.write(61600, 0, 11 * S)
    assert not armed.watchdog.armed
    assert armed.watchdog.due_ns is None


def test_a_trip_is_over_with_the_next_request(armed):
    """This device has no step that clears one."""
    armed.watchdog.tripped = True
    assert armed.watchdog.due_ns is None
    armed.watchdog.request(20 * S)
    assert not armed.watchdog.tripped
    assert armed.watchdog.due_ns == 23 * S
