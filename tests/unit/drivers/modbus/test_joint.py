"""Several outputs of a Modbus device: one transaction, and the results of one output at a time."""

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl.base.errors import DeviceError
from tests.unit.drivers.modbus.conftest import RATE_HZ

CHANNELS = {
    "labjack_t7": (("DAC0", "AIN0"), ("DAC1", "AIN1")),
    "wago_750": (("AO0", "AI0"), ("AO1", "AI1")),
    "beckhoff_bk9000": (("AO0", "AI0"), ("AO1", "AI1")),
}
FUNCTION = {"labjack_t7": 76, "wago_750": 23, "beckhoff_bk9000": 23}


class Pair:
    """Two outputs of an emulated device, as x and y."""

    def __init__(self, driven, profile, **changes):
        (output, source), (other, other_source) = CHANNELS[profile]
        self.made = driven(profile, output=output, input=source, **changes)
        self.x, self.link = self.made.device, self.made.link
        self.y = self.made.another(output=other, input=other_source)
        self.joint = joined({"x": self.x, "y": self.y})["x", "y"]

    def open(self):
        self.joint.open(RATE_HZ, 1)
        self.x.arm()
        self.y.arm()
        self.link.requests.clear()

    def exchange(self, *values):
        found = np.full((2, 1), np.nan)
        commands = [np.array([each]) for each in values]
        self.joint.exchange(0, commands, [*found], [np.full(1, np.nan) for _ in values])
        return found[:, 0].tolist()

    @property
    def functions(self):
        return [each[7] for each in self.link.requests]

    def held(self):
        return [each.output() for each in (self.x, self.y)]


@pytest.fixture(params=CHANNELS)
def profile(request):
    return request.param


def test_one_transaction_sets_both_outputs_and_reads_both_inputs(driven, profile):
    pair = Pair(driven, profile)
    pair.open()
    assert [each.info.details["transactions"] for each in (pair.x, pair.y)] == ["1", "1"]
    found = pair.exchange(2.0, -3.0)
    assert np.isfinite(found).all()
    assert pair.functions == [FUNCTION[profile]]
    assert pair.held() == pytest.approx([2.0, -3.0], abs=0.02)
    assert pair.joint.max_rate_hz == pair.x.info.max_rate_hz


def test_auxiliary_channels_of_all_axes_are_in_it(driven):
    changes = {"aux": {"coil_v": {"input": "AIN2"}, "rod_v": {"input": "AIN3"}}}
    pair = Pair(driven, "labjack_t7", **changes)
    pair.open()
    pair.x.aux[:] = np.nan
    pair.exchange(0.0, 0.0)
    assert pair.functions == [76]
    assert np.isfinite(pair.x.aux).all()
    assert pair.y.aux.size == 2


def test_a_bad_command_of_one_axis_sends_nothing(driven, profile):
    pair = Pair(driven, profile)
    pair.open()
    for commands in ((1.0, 99.0), (np.nan, 1.0)):
        with pytest.raises(DeviceError, match="nothing was sent"):
            pair.exchange(*commands)
    assert pair.functions == []


def test_each_output_is_made_safe_with_the_joint_open_and_closed(driven, profile):
    pair = Pair(driven, profile)
    pair.open()
    pair.exchange(2.0, -3.0)
    pair.y.make_safe(1.0)
    pair.x.make_safe(0.5)
    pair.joint.close()
    apart = pair.made.another(output=CHANNELS[profile][1][0], input=CHANNELS[profile][1][1])
    assert apart.look().output == pytest.approx(1.0, abs=0.02)
    pair.x.make_safe(0.0)
    assert pair.x.look().output == pytest.approx(0.0, abs=0.02)


def test_a_lost_device_is_lost_for_all_axes(driven, profile):
    pair = Pair(driven, profile)
    pair.open()
    pair.link.silent_until_s = 1e9
    with pytest.raises(DeviceError):
        pair.exchange(1.0, 1.0)
    for device in (pair.x, pair.y):
        with pytest.raises(DeviceError, match="not open"):
            device.output()
    pair.joint.close()


def test_devices_on_other_addresses_or_of_other_kinds_stay_on_their_own(driven):
    made = driven("labjack_t7")
    other = made.another(output="DAC1", input="AIN1", unit_id=9)
    assert [*joined({"x": made.device, "y": other})] == [("x",), ("y",)]
    assert [*joined({"x": made.device})] == [("x",)]


def test_an_output_that_cannot_be_read_back_is_written_apart(driven):
    made = driven("labjack_t7", output="DAC0", input="AIN0")
    tdac = made.another(output="TDAC1", input="AIN1")
    joint = joined({"x": made.device, "y": tdac})["x", "y"]
    assert joint.max_rate_hz < made.device.info.max_rate_hz  # function 76 cannot be tried


def test_clearing_a_trip_brings_back_no_last_command_of_any_output(driven):
    watchdog = {"timeout_s": 0.5, "safe_command": 0.0}
    pair = Pair(driven, "wago_750", watchdog=watchdog)
    pair.open()
    pair.exchange(2.0, -3.0)
    pair.made.time.sleep(1.0)
    with pytest.raises(DeviceError):
        pair.exchange(2.0, -3.0)
    assert pair.made.emulated.device.tripped
    pair.open()
    assert not pair.made.emulated.device.tripped
    assert pair.held() == pytest.approx([0.0, 0.0], abs=0.02)
    pair.joint.close()
