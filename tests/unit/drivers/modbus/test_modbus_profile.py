"""Profiles of Modbus devices: silence on the line, watchdog steps with numbers, broken rules."""

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl_drivers.modbus.modbus_profile import ModbusRtuLink
from hilctl_drivers.modbus.register_map import EnsureStep, RegisterStep
from hilctl_drivers.profile import load_profile, parse_profile, shipped_profiles


@pytest.mark.parametrize(
    ("baud", "silence_s"), [(9600, 3.5 * 10 / 9600), (19200, 3.5 * 10 / 19200), (38400, 0.00175)]
)
def test_silence_before_a_frame(baud, silence_s):
    """3.5 characters up to 19200 baud, 1.75 ms above; a profile may know better."""
    link = {"kind": "rtu", "baud": baud}
    assert ModbusRtuLink(**link).silence_s == pytest.approx(silence_s)
    assert ModbusRtuLink(**link, gap_s=0.004).silence_s == 0.004


def test_watchdog_steps_are_bound_to_numbers():
    profile = load_profile("icp_m7024")
    output = profile.outputs["AO0"]
    safe = (EnsureStep(kind="ensure", address=40500, type="int16", value="safe"),)
    steps = profile.watchdog.bound((*profile.watchdog.arm, *safe), output, 10.0, -10.0)
    timeout, enable, value = (step for step in steps if isinstance(step, RegisterStep))
    assert timeout.format.encode(timeout.value) == (100).to_bytes(2, "big")
    assert enable == profile.watchdog.arm[1]
    assert value.format.encode(value.value) == (-32767).to_bytes(2, "big", signed=True)
    with pytest.raises(InputError, match="multiple"):
        profile.watchdog.bound(profile.watchdog.arm, output, 0.15, 0.0)


@pytest.fixture
def text():
    return shipped_profiles()["labjack_t7"].read_text(encoding="utf-8")


def test_rate_and_depth_follow_from_the_device_s_own_figures(text):
    streaming = parse_profile(text, "here").streaming
    assert (streaming.fifo_depth, streaming.rate_max_hz(1)) == (8192, 50_000.0)


@pytest.mark.parametrize(("name", "old", "new", "rule"), [
    ("generic_float32", "OUT: {address: 0,", "OUT: {address: 1,", "registers of .* overlap"),
    ("icp_m7024", "kind: rtu,", "kind: rtu, bytesize: 7,", "link.bytesize"),
])  # fmt: skip
def test_lines_and_registers_that_cannot_work_are_refused(name, old, new, rule):
    text = shipped_profiles()[name].read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(ConfigError, match=rule):
        parse_profile(text.replace(old, new, 1), "here")


@pytest.mark.parametrize(("old", "new", "rule"), [
    ("buffer_bytes: 16384", "buffer_bytes: 16000", "buffer_bytes must be a power of 2"),
    ("buffer_bytes: 16384", "buffer_bytes: 16", "buffer_bytes"),
    ("outputs: [DAC0, DAC1]", "outputs: [DAC0, DAC7]", "streaming.outputs must be outputs"),
    ("inputs: [AIN0, ", "inputs: [AIN9, ", "streaming.inputs must be inputs"),
    ("kind: labjack\n", "kind: other\n", "kind"),
    ("calibration: two_slopes", "calibration: none", "calibration"),
])  # fmt: skip
def test_rules_are_told(text, old, new, rule):
    assert old in text
    with pytest.raises(ConfigError, match=rule):
        parse_profile(text.replace(old, new), "here")
