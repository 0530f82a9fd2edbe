"""Profiles of Modbus devices: silence on the line, watchdog steps with numbers, broken rules."""

import pytest
from pydantic import ValidationError

from hilctl.base.errors import ConfigError
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile, ModbusRtuLink
from hilctl_drivers.profile import load_profile, parse_profile, shipped_profiles

T7 = load_profile("labjack_t7")


def changed(**changes):
    return ModbusProfile.model_validate({**T7.model_dump(), **changes})


@pytest.mark.parametrize(
    ("baud", "silence_s"), [(9600, 3.5 * 10 / 9600), (19200, 3.5 * 10 / 19200), (38400, 0.00175)]
)
def test_silence_before_a_frame(baud, silence_s):
    """3.5 characters up to 19200 baud, 1.75 ms above; a profile may know better."""
    link = {"kind": "rtu", "baud": baud}
    assert ModbusRtuLink(**link).silence_s == pytest.approx(silence_s)
    assert ModbusRtuLink(**link, gap_s=0.004).silence_s == 0.004


def test_watchdog_steps_get_the_device_s_own_numbers():
    """The timeout in counts of its unit, the safe value scaled as the output is."""
    watchdog, output = T7.watchdog, T7.outputs["DAC0"]
    timeout = next(s for s in watchdog.bound(watchdog.arm, output, 5.0, 1.0) if s.address == 61604)
    assert (timeout.value, timeout.scale) == (5.0, 1.0)
    safe = watchdog.bound(watchdog.safe["DAC0"], output, 5.0, 1.25)[-1]
    assert safe.value == 1.25


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"outputs": {}, "streaming": "none", "watchdog": "none"}, "exchange must be none"),
        ({"exchange": 23, "inputs": {"AIN0": {**T7.inputs["AIN0"].model_dump(), "area": "input"}},
          "streaming": "none"}, "inputs.AIN0.area must be holding: exchange 23"),
        ({"init": ({"kind": "write", "address": 1, "type": "uint32", "value": "safe"},)},
         "init: timeout and safe are for watchdog steps"),
        ({"address_base": "modicon"}, "address must be in area holding with address_base modicon"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_refused(changes, said):
    with pytest.raises(ValidationError, match=said):
        changed(**changes)


def test_an_output_is_a_register_that_its_function_can_write():
    output = {"address": 1, "type": "float32", "unit": "V", "min": 0.0, "max": 5.0}
    with pytest.raises(ValidationError, match="must be holding"):
        ModbusOutput(**output, area="input")
    with pytest.raises(ValidationError, match=r"function 6 .*float32"):
        ModbusOutput(**output, function=6)
    assert ModbusOutput(**output, readback="none").readback_register is None


@pytest.fixture
def text():
    return shipped_profiles()["labjack_t7"].read_text(encoding="utf-8")


def test_rate_and_depth_follow_from_the_device_s_own_figures(text):
    """Two channels share the sample rate; a sample takes two bytes."""
    streaming = parse_profile(text, "here").streaming
    assert (streaming.fifo_depth, streaming.rate_max_hz) == (8192, 50_000.0)


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("buffer_bytes: 16384", "buffer_bytes: 16000", "buffer_bytes must be a power of 2"),
        ("buffer_bytes: 16384", "buffer_bytes: 16", "buffer_bytes"),
        ("outputs: [DAC0, DAC1]", "outputs: [DAC0, DAC7]", "streaming.outputs must be outputs"),
        ("inputs: [AIN0, ", "inputs: [AIN9, ", "streaming.inputs must be inputs"),
        ("kind: labjack\n", "kind: other\n", "kind"),
        ("calibration: two_slopes", "calibration: none", "calibration"),
    ],
)
def test_rules_are_told(text, old, new, rule):
    """Each broken rule names its key."""
    assert old in text
    with pytest.raises(ConfigError, match=rule):
        parse_profile(text.replace(old, new), "here")
