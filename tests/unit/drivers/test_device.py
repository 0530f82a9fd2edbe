"""What every device does whatever it speaks: sizes, range, errors, and letting go."""

import numpy as np
import pytest

from hilctl.base.device import DeviceInfo, DeviceReadings
from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.device import DacDevice

INFO = DeviceInfo(
    name="dac", description="a DAC", command_unit="A", command_min=-2.0, command_max=2.0,
    sensor_min_um=-50.0, sensor_max_um=50.0, max_rate_hz=1000.0,
)  # fmt: skip


class NotingDac(DacDevice):
    """Notes what it is asked; fails where it is told to."""

    block_note = ", as its queue holds"

    def __init__(self, longest=1):
        super().__init__(INFO, "dac at /dev/x", "exchange", "output AO")
        self.block_max, self.calls, self.broken = longest, [], ""

    def _note(self, name):
        self.calls.append(name)
        if name == self.broken:
            raise DeviceError("no answer")

    def _open(self, sample_rate_hz, block):
        self._note("open")

    def _arm(self):
        self._note("arm")

    def _output(self):
        self._note("output")

    def _look(self):
        self._note("look")
        return DeviceReadings(1.0, None)

    def _exchange(self, first_sample, command, displacement_um, measured):
        self._note("exchange")

    def _put_out(self, command):
        self._note("put out")

    def _close(self):
        self._note("close")

    def _release(self):
        self.calls.append("release")


def exchange(device, *command):
    values = np.array(command)
    device.exchange(0, values, np.empty(values.size), np.empty(values.size))


@pytest.mark.parametrize("place", [0, -1])
@pytest.mark.parametrize("longest", [1, 3, 64, 65])
@pytest.mark.parametrize("bad", [2.0001, -2.0001, np.nan, np.inf, -np.inf])
def test_a_command_out_of_range_is_refused_and_not_sent(longest, bad, place):
    device = NotingDac(longest)
    device.open(1000.0, longest)
    command = [0.0] * longest
    exchange(device, *command)
    command[place] = bad
    with pytest.raises(DeviceError, match=r"\[-2, 2\] A.*nothing"):
        exchange(device, *command)
    with pytest.raises(DeviceError, match="nothing was sent"):
        device.make_safe(bad)
    exchange(device, *[2.0] * longest)
    assert device.calls.count("exchange") == 2
    assert "put out" not in device.calls


def test_blocks_are_as_agreed_at_open():
    device = NotingDac(3)
    with pytest.raises(DeviceError, match="not open"):
        exchange(device, 0.0)
    device.open(1000.0, 2)
    with pytest.raises(DeviceError, match=r"2 samples.* 1, 1, 1"):
        exchange(device, 0.0)
    with pytest.raises(DeviceError, match="1 to 3 samples"):
        device.open(1000.0, 4)
    with pytest.raises(DeviceError, match="not open"):
        exchange(device, 0.0, 0.0)


def test_a_rate_beyond_the_device_is_refused_before_it_is_opened():
    device = NotingDac()
    with pytest.raises(DeviceError, match="1000"):
        device.open(1001.0, 1)
    assert "open" not in device.calls


@pytest.mark.parametrize("step", ["open", "arm", "output", "exchange", "close", "put out"])
def test_after_an_error_nothing_is_held(step):
    device = NotingDac()
    device.broken = step

    def life():
        device.open(1000.0, 1)
        device.arm()
        device.output()
        if step == "put out":
            device.make_safe(0.0)
        exchange(device, 0.0)
        device.close()

    with pytest.raises(DeviceError, match=r"dac at /dev/x: no answer \(to "):
        life()
    assert device.calls[-1] == "release"
    with pytest.raises(DeviceError, match="not open"):
        exchange(device, 0.0)


def test_closing_twice_says_goodbye_once():
    device = NotingDac()
    device.open(1000.0, 1)
    device.close()
    device.close()
    assert device.calls.count("close") == 1


def test_looking_is_for_a_device_that_is_closed():
    device = NotingDac()
    assert device.look()[:2] == (1.0, None)
    device.broken = "look"
    with pytest.raises(DeviceError, match=r"dac at /dev/x: no answer \(to read the"):
        device.look()
    assert device.calls == ["look", "release"] * 2
    device.open(1000.0, 1)
    with pytest.raises(DeviceError, match="open"):
        device.look()
    exchange(device, 0.0)


@pytest.mark.parametrize("error", [DeviceError, UnconfirmedError])
def test_what_cannot_be_confirmed_is_told_from_what_failed(error):
    class Sent(NotingDac):
        def _put_out(self, command):
            raise error("sent")

    with pytest.raises(DeviceError, match=r"dac at /dev/x: sent \(to make safe") as caught:
        Sent().make_safe(0.0)
    assert type(caught.value) is error
