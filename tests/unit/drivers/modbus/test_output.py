"""What an open modbus_dac says that it puts out."""

import pytest

from hilctl.base.errors import DeviceError


def test_device_as_it_powers_up(driven):
    """A LabJack gives 0 V, which the amplifier makes the end of its range; opening leaves it."""
    made = driven("labjack_t7", current_a=None)
    made.open()
    assert made.device.output() == pytest.approx(-10.0)
    assert {each["current_a"] for each in made.writes()} == {-10.0}


@pytest.mark.parametrize("profile", ["labjack_t7", "wago_750", "adam_6024", "generic_float32"])
def test_output_of_the_run_before(driven, profile):
    """It stays between connections, and is read from the register that the profile names."""
    made = driven(profile)
    made.device.open(5.0, 1)
    made.exchange(3.0)
    assert made.device.output() == pytest.approx(3.0, abs=1e-2)
    made.device.close()
    made.device.open(5.0, 1)
    assert made.device.output() == pytest.approx(made.current_a, abs=1e-9)
    assert made.current_a == pytest.approx(3.0, abs=1e-2)


def test_value_out_of_range_is_returned_as_it_is(driven):
    """It is for the run to refuse it."""
    made = driven()
    made.open()
    made.emulated.device._outputs["OUT"].value = 17.0
    assert made.device.output() == pytest.approx(17.0)


def test_output_that_can_not_be_read_is_not_known(driven, write_only):
    """Nothing is guessed."""
    made = driven(write_only)
    made.open()
    made.exchange(3.0)
    assert made.device.output() is None


def test_silent_device_must_be_opened_again(driven):
    """It is asked, or there is no answer."""
    made = driven()
    with pytest.raises(DeviceError, match="not open"):
        made.device.output()
    made.open()
    made.link.silent_until_s = 1e9
    with pytest.raises(DeviceError, match=r"no answer .* \(to read the output back\)"):
        made.device.output()
    made.link.silent_until_s = 0.0
    with pytest.raises(DeviceError, match="not open"):
        made.exchange(1.0)
