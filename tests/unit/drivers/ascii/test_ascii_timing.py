"""How long lines of text take."""

import pytest

from hilctl_drivers.ascii.ascii_timing import exchange_time, feed_time
from hilctl_drivers.ascii.ascii_wire import AsciiWire
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.serial.serial_setup import SerialOptions, SerialSetup
from hilctl_drivers.transport.wire_time import WireTime

CHAR_S = 10 / 9600
READER = """\
vendor: Acme
model: ADC-1
source: [manual]
verified: "yes"
link: {kind: ascii, baud: 9600, terminator: "\\r", reply_terminator: "\\r"}
address: 2
exchange: none
turnaround_s: 0.0
max_rate_hz: 100.0
outputs:
  NONE:
    {write: "#{address:02X}{value:+07.3f}", reply: none, unit: V, min: 0.0, max: 1.0}
inputs:
  AI:
    {ask: "#{address:02X}0", pattern: ">([+-][0-9.]+)", example: ">+05.000", unit: V, min: -10.0,
     max: 10.0}
watchdog: none
"""


def wire_s(time: WireTime) -> float:
    """Return the time of the characters alone."""
    return time.request_s + time.reply_s


class TestText:
    """Lines of text."""

    def test_dcon(self) -> None:
        """#010+05.000 and > with their carriage returns are 14 characters."""
        profile = load_profile("icp_m7024_dcon")
        time = exchange_time(profile, "AO0", None)
        assert wire_s(time) == pytest.approx(14 * 10 / 9600)
        assert wire_s(exchange_time(with_link(profile, checksum="dcon"), "AO0", None)) == (
            pytest.approx(18 * 10 / 9600)
        )

    def test_gap(self) -> None:
        """TDK-Lambda's 5 ms come once a line."""
        time = exchange_time(load_profile("tdk_lambda_gen"), "current", "current")
        assert (time.gaps, time.gaps_s) == (2, 0.01)
        assert time.request_s == pytest.approx((13 + 7) * 10 / 9600)  # PC 38.000$XX, MC?$XX
        assert time.reply_s == pytest.approx((6 + 10) * 10 / 9600)  # OK$XX, 05.003$XX

    def test_one_line(self) -> None:
        """A line that sets and asks saves the second one."""
        profile = load_profile("kepco_bop")
        one = exchange_time(profile, "current", "current")
        two = exchange_time(profile, "current", "current", one_transaction=False)
        assert one.what == "1 line at 19200 8N1"
        assert two.what == "2 lines at 19200 8N1"
        assert two.turnaround_s == one.turnaround_s  # a CURR of its own is not answered
        line = "CURR -12.000000;:MEAS:CURR?\n"
        assert one.request_s == pytest.approx(len(line) * 10 / 19200)


@pytest.mark.parametrize("name", ["kepco_bop", "tdk_lambda_gen"])
def test_devices_without_a_strict_watchdog_cost_nothing(name):
    """Exchanges feed it, or there is none."""
    assert feed_time(load_profile(name)) is None


def test_an_unanswered_line_costs_its_characters():
    """DCON's ~** is heard by all modules on the line and answered by none."""
    time = feed_time(load_profile("icp_m7024_dcon"))
    assert time.total_s == time.request_s == pytest.approx(len("~**\r") * CHAR_S)


def serial_rates(path, watchdog):
    """Return the highest rate that serial_dac gives, and why, for an ICP M-7024."""
    options = {
        "profile": "icp_m7024_dcon",
        "serial_port": "/dev/ttyUSB0",
        "reader": {"profile": str(path), "unit_id": 2},
        "output": "AO0",
        "input": "AI",
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "watchdog": watchdog,
    }
    return AsciiWire(SerialSetup.of(SerialOptions.model_validate(options))).rates(1)


def test_serial_dac_leaves_room_for_feeding(tmp_path):
    """Four characters more in the sample period, where the experiment uses the watchdog."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER)
    bare, fed = serial_rates(path, "none"), serial_rates(path, {"timeout_s": 1.0})
    assert 1.0 / fed.highest_hz - 1.0 / bare.highest_hz == pytest.approx(4 * CHAR_S)
    assert "to feed the watchdog: request" in fed.note
    assert "to feed" not in bare.note


def test_settling_is_told():
    """An M-7024's output takes 10 ms, and the note says so."""
    time = exchange_time(load_profile("icp_m7024_dcon"), "AO0", None)
    assert time.total_s - time.answered_s == pytest.approx(0.01)
    assert "settling 10.00 ms" in str(time)
