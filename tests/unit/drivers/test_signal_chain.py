"""Watchdogs that cannot do what is asked of them, and channels that cannot be wired so."""

import pytest
from pydantic import ValidationError

from hilctl.base.calibration import AmplifierCalibration
from hilctl.base.errors import InputError
from hilctl_drivers.ascii.ascii_profile import AsciiWatchdog
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import Range
from hilctl_drivers.signal_chain import (
    AddressOptions,
    Amplifier,
    Calibration,
    DacOptions,
    Sensor,
    SignalChain,
    channel,
    check_watchdog,
)

VOLTS = Range(unit="V", min=-10.0, max=10.0)


def asked(has, offset_a=0.0, **wanted):
    """Hold a wanted watchdog against what a device has, on output B."""
    options = DacOptions.model_validate(
        {
            "profile": "generic_float32",
            "host": "h",
            "output": "B",
            "input": "I",
            "amplifier": {"gain_a_per_v": 2.0, "offset_a": offset_a},
            "sensor": {"um_per_v": 1.0},
            "watchdog": {"timeout_s": 1.0, **wanted},
        }
    )
    chain = SignalChain(VOLTS, VOLTS, options.amplifier, options.sensor)
    assert chain.command_step == 2.0 * VOLTS.step
    check_watchdog("Acme", options, VOLTS, chain, has)


def watchdog(**changes):
    arm = ({"kind": "send", "text": "W{timeout} {safe}"},)
    data = {
        "unit_s": 0.1, "min_s": 0.1, "max_s": 10.0, "kick": "any", "on_trip": "safe",
        "refuses_while_tripped": False, "arm": arm, **changes,
    }  # fmt: skip
    return AsciiWatchdog.model_validate(data)


@pytest.mark.parametrize(("has", "wanted", "words"), [
    ("none", {}, "Acme has no host watchdog: it holds its last output"),
    (watchdog(), {"timeout_s": 20.0}, "timeout_s must be 0.1 to 10"),
    (watchdog(), {"safe_command": 30.0}, "safe_command must be -20 to 20, got 30"),
    (watchdog(safe={"A": ()}), {}, " B, only on A: "),
    (watchdog(on_trip="hold"), {}, "holds the value of B .*: set watchdog: none"),
    (watchdog(on_trip="zero"), {"safe_command": 3.0}, "B to 0 V, which is 0 A here"),
    (watchdog(on_trip="reset"), {"offset_a": 1.0}, "which is 1 A here: .* got 0"),
])  # fmt: skip
def test_watchdog_that_does_not_do_what_is_asked_is_refused(has, wanted, words):
    with pytest.raises(InputError, match=words):
        asked(has, **wanted)


@pytest.mark.parametrize("has", [watchdog(), watchdog(safe={"B": ()}), watchdog(on_trip="zero")])
def test_watchdog_that_does_is_taken(has):
    """A safe value, one for this output among others, or 0 where that is asked for."""
    asked(has)


@pytest.mark.parametrize(("unit", "sensor", "span"), [
    ("V", {"um_per_v": 2.0, "offset_um": 1.0}, [-1.0, 9.0]),
    ("um", {}, [-1.0, 4.0]),
    ("mm", {"offset_um": 5.0}, [-995.0, 4005.0]),
    ("nm", {}, [-1e-3, 4e-3]),
    ("mm", {"um_per_mm": -1000.0}, [-4000.0, 1000.0]),
])  # fmt: skip
def test_position_needs_no_sensitivity(unit, sensor, span):
    source = Range(unit=unit, min=-1.0, max=4.0)
    amplifier = Amplifier(gain_a_per_v=1.0)
    chain = SignalChain(VOLTS, source, amplifier, Sensor.model_validate(sensor))
    assert chain.displacement_range == pytest.approx(span)


@pytest.mark.parametrize(("unit", "sensor"), [
    ("V", {}), ("mA", {"um_per_v": 1.0}), ("mm", {"um_per_um": 1.0}), ("A", {}),
])  # fmt: skip
def test_sensitivity_must_fit_the_input(unit, sensor):
    source = Range(unit=unit, min=-1.0, max=4.0)
    with pytest.raises(InputError, match=f"in {unit}|gives {unit}"):
        SignalChain(VOLTS, source, Amplifier(gain_a_per_v=1.0), Sensor.model_validate(sensor))


@pytest.mark.parametrize(("host", "words"), [
    ("h:502", "set host to h and tcp_port to 502"), ("[::1]:502", "set host to ::1 and tcp_port"),
    *((each, "host name or an IP address") for each in
      ("", " ", "..", "a..b", ".", "a\0b", "a b", "-a", "a-", "http://h", "300::x", "h" * 64)),
])  # fmt: skip
def test_malformed_hosts_are_refused(host, words):
    with pytest.raises(ValidationError, match=words):
        AddressOptions.model_validate({"profile": "icp_et7000", "host": host})


@pytest.mark.parametrize(
    "host", ["h", "plc_3.lab", "Rig-1.lab.", "10.0.0.7", "::1", "fe80::1%eth0", "müller.local"]
)
def test_hosts_are_names_or_addresses(host):
    assert AddressOptions.model_validate({"profile": "icp_et7000", "host": host}).host == host


@pytest.mark.parametrize("path", ["", " ", "/dev/tty\0"])
def test_malformed_device_files_are_refused(path):
    with pytest.raises(ValidationError, match="device file"):
        AddressOptions.model_validate({"profile": "cobs_board", "serial_port": path})


@pytest.mark.parametrize("date", ["soon", "15.1.2026"])
def test_a_calibration_has_a_date(date):
    note = {"by": "N. N.", "reference": "gauge block"}
    assert Calibration.model_validate({**note, "date": "2026-01-15"}).date.year == 2026
    with pytest.raises(ValidationError, match="date"):
        Calibration.model_validate({**note, "date": date})


def test_channels_are_found_by_name():
    assert channel("input", "A", {"A": VOLTS}, "Acme") is VOLTS
    two = {"A": VOLTS, "B": VOLTS}
    with pytest.raises(InputError, match=r"'C' .*A, B"):
        channel("input", "C", two, "Acme")
    with pytest.raises(InputError, match=r"\(it has none\)"):
        channel("input", "C", {}, "Acme")


def test_input_of_its_own_output_is_no_sensor():
    supply = load_profile("kepco_bop")
    with pytest.raises(InputError, match="as reader"):
        channel("input", "current", supply.inputs, supply.title)


def test_a_calibrated_amplifier_puts_out_the_command():
    origin = {"date": "2026-01-31", "by": "N. N.", "reference": "shunt"}
    left = {"residual_rms": 0.0, "residual_max": 0.0}
    line = {"unit": "A", "range": (-1.0, 1.0), "gain": 1.02, "offset": 0.1}
    calibrated = AmplifierCalibration.model_validate(origin | left | line)
    given = Amplifier(gain_a_per_v=2.0, offset_a=-1.0), Sensor(um_per_v=1.0)
    nominal, chain = (
        SignalChain(VOLTS, VOLTS, *given),
        SignalChain(VOLTS, VOLTS, *given, calibrated),
    )
    for command in (-3.0, 0.0, 2.5):
        actual = 1.02 * nominal.command(chain.output(command)) + 0.1
        assert actual == pytest.approx(command)
        assert chain.command(chain.output(command)) == pytest.approx(command)
    assert chain.measured(VOLTS) == nominal.measured(VOLTS) == (2.0, -1.0)
    assert chain.command_range == pytest.approx([1.02 * each + 0.1 for each in (-21.0, 19.0)])
    with pytest.raises(InputError, match=r"amplifier\.unit"):
        SignalChain(VOLTS, VOLTS, *given, calibrated.model_copy(update={"unit": "V"}))
