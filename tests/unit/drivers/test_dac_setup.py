"""Any output with any sensor: what is known of a pair before it is opened, and what it costs."""

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.devices import device_class
from hilctl_drivers import endpoint
from hilctl_drivers.board.board_session import exchange_time
from hilctl_drivers.profile import load_profile

WIRING = {"amplifier": {"gain_a_per_v": 1.0}, "sensor": {"um_per_v": 12.5}, "watchdog": "none"}
OUTPUTS = {
    "cobs_board_fifo": "DAC",
    "adam_6224": "AO0",
    "icp_m7024": "AO0",
    "icp_m7024_dcon": "AO0",
    "cobs_board": "DAC",
}
INPUTS = {"labjack_t7": "AIN0", "icp_m7017": "AI0", "agilent_34970a": "AI101", "cobs_board": "ADC"}


HOSTS = "localhost", "127.0.0.1"


def described(output, reader, /, **changes):
    """Return the description of a device with one profile's output and another one's input."""
    profile = load_profile(output)
    place = {"host": "10.0.0.7"} if profile.link.kind == "tcp" else {"serial_port": "/dev/x"}
    on_tcp = load_profile(reader).link.kind == "tcp"
    there = {"host": "10.0.0.8"} if on_tcp else {"serial_port": "/dev/y"}
    options = {
        **WIRING, **place, "profile": output, "output": OUTPUTS[output], "input": INPUTS[reader],
        "reader": {"profile": reader, **there}, **changes,
    }  # fmt: skip
    chosen = device_class(profile.DEVICE)
    return chosen(chosen.Options.model_validate(options)).info


@pytest.mark.parametrize("reader", INPUTS)
@pytest.mark.parametrize("output", sorted(set(OUTPUTS) - {"cobs_board_fifo"}))
def test_any_output_goes_with_any_sensor(output, reader):
    info = described(output, reader)
    profiles = load_profile(output), load_profile(reader)
    assert info.details["reader_model"] == profiles[1].model
    assert 0.0 < info.max_rate_hz <= min(each.max_rate_hz for each in profiles)
    places = {"10.0.0.7", "/dev/x"}, {"10.0.0.8", "/dev/y"}
    for place in places:
        assert sum(name in held for held in info.holds for name in place) == 1


def test_an_output_keeps_its_name_and_its_device_all_names():
    """The state between runs follows the output, not the reader and not the host's name."""
    one, other = (described("adam_6224", "labjack_t7", host=host) for host in HOSTS)
    assert set(one.identity) & set(other.identity)
    assert not any("10.0.0.8" in name for name in one.identity)
    assert set(one.identity) < set(one.holds)
    outputs = {
        described("adam_6224", "labjack_t7", **changes).output
        for changes in ({}, {"output": "AO1"}, {"unit_id": 9}, {"host": "10.0.0.9"})
    }
    assert len(outputs) == 3
    assert one.output in outputs


def test_an_adapter_is_known_by_its_serial_number_at_any_path(monkeypatch, tmp_path):
    monkeypatch.setattr(endpoint, "adapter_of", lambda path: "usb:0001:0002:A1:1.0")
    (tmp_path / "by-id").symlink_to("/dev/null")
    for path in ("/dev/null", str(tmp_path / "by-id")):
        info = described("icp_m7024", "labjack_t7", serial_port=path)
        assert info.identity[0] == "usb:0001:0002:A1:1.0"
        assert "serial:/dev/null" in info.identity


def test_the_rate_is_that_of_both_exchanges():
    """A LabJack answers within 1 ms."""
    both_s = exchange_time(load_profile("cobs_board")).total_s + 0.001
    assert described("cobs_board", "labjack_t7").max_rate_hz == pytest.approx(1.0 / both_s)


@pytest.mark.parametrize(
    ("output", "changes", "words"),
    [
        ("cobs_board_fifo", {}, "reader must be omitted"),
        ("adam_6224", {"timeout_s": 1e-3}, "timeout_s must be >"),
        ("adam_6224", {"input": "AIN9"}, "input must be one that LabJack T7 has"),
    ],
)
def test_what_does_not_go_together_is_refused(output, changes, words):
    with pytest.raises((InputError, ValueError), match=words):
        described(output, "labjack_t7", **changes)
