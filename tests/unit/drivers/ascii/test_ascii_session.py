"""Asking a device in lines of text: templates out, patterns back, trouble by its own name."""

from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_dac import AsciiDac
from hilctl_drivers.ascii.ascii_session import AsciiSession, exchange_time, feed_time
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.serial_dac import SerialOptions
from hilctl_drivers.transport.links import (
    CorruptError,
    MismatchError,
    NoAnswerError,
    RefusedError,
    WatchdogTrippedError,
)
from hilctl_drivers.transport.wire_time import WireTime

DCON = load_profile(str(Path(__file__).parents[3] / "data" / "dcon_module.yaml"))
PLAIN = DCON.model_copy(update={"link": DCON.link.model_copy(update={"checksum": "none"})})


class ScriptedLink:
    """Answers with the lines that a test gives, one a request."""

    def __init__(self, *replies):
        self.replies, self.sent, self.missing = list(replies), [], None

    def transact(self, request, missing, usual=0):
        self.sent.append(bytes(request))
        self.missing = missing
        if missing(bytearray()) == 0:
            return b""
        reply = self.replies.pop(0)
        if reply is None:
            raise NoAnswerError("no answer within 0.1 s")
        return reply


def session(*replies, profile=PLAIN, sleep=None):
    return AsciiSession(profile, ScriptedLink(*replies), 2, sleep or (lambda seconds: None))


def test_a_value_is_put_in_and_a_number_comes_out():
    asked = session(b">+05.123\r")
    assert asked.number(PLAIN.inputs["AI0"]) == 5.123
    assert asked.text(PLAIN.outputs["AO0"].write, value=-1.5) == "#020-01.500"
    assert asked.link.sent == [b"#020\r"]


def test_a_checksum_goes_along():
    asked = session(b">AF\r", profile=DCON)
    with pytest.raises(DeviceError):
        asked.ask("#020", ">")
    assert asked.link.sent[0].endswith(b"\r")
    assert len(asked.link.sent[0]) == len(b"#020\r") + 2


@pytest.mark.parametrize(
    ("reply", "error", "said"),
    [
        (b"?\r", RefusedError, r"#020: out of range \(\?\)"),
        (b"?02\r", RefusedError, "invalid command"),
        (b"!\r", WatchdogTrippedError, "ignored, the host watchdog has tripped"),
        (b"ok\r", MismatchError, "not an answer to this: 'ok'"),
        (b">>\r", MismatchError, "not an answer to this"),
        (None, NoAnswerError, "#020: no answer within 0.1 s"),
    ],
)
def test_trouble_is_told_with_what_was_asked(reply, error, said):
    with pytest.raises(error, match=said):
        session(reply).ask("#020", ">")


def test_another_address_answers_for_nobody():
    with pytest.raises(MismatchError, match="address 03"):
        session(b"!037024\r").ask("$02M", "![0-9A-F]{2}.*")


def test_a_line_is_waited_for_to_its_end_but_not_for_ever():
    asked = session(b">\r")
    asked.ask("#020", ">")
    missing = asked.link.missing
    assert (missing(bytearray(b">")), missing(bytearray(b">\r"))) == (1, 0)
    with pytest.raises(CorruptError, match="no end of"):
        missing(bytearray(1 << 16))


def test_a_step_that_fails_says_what_it_was_for():
    step = PLAIN.watchdog.arm[0].model_copy(update={"note": "arm it"})
    asked = session(b"?02\r")
    with pytest.raises(DeviceError, match=r"\(\?02\) \(arm it\)"):
        asked.run((step,), timeout=10)
    assert asked.link.sent == [b"~02310A\r"]


def test_what_is_not_answered_is_not_waited_for():
    asked = session()
    asked.run(PLAIN.watchdog.feed)
    assert asked.link.sent == [b"~**\r"]


@pytest.mark.parametrize(("reply", "tripped"), [(b"!0204\r", True), (b"!0200\r", False)])
def test_a_trip_is_asked_for(reply, tripped):
    assert session(reply).tripped() is tripped


def test_the_wrong_device_is_told_by_its_answer():
    session(b"!027024\r").check_selftest()
    with pytest.raises(DeviceError, match="'!027024', got '!024017'"):
        session(b"!024017\r").check_selftest()


def test_an_echo_must_be_what_was_sent():
    link = PLAIN.link.model_copy(update={"echo": True})
    profile = PLAIN.model_copy(update={"link": link})
    session(b"#020\r>\r", profile=profile).ask("#020", ">")
    with pytest.raises(CorruptError, match="b'#030'"):
        session(b"#030\r>\r", profile=profile).ask("#020", ">")


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
        apart = profile.model_copy(update={"exchange": "none"})
        two = exchange_time(apart, "current", "current")
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
    return AsciiDac(SerialOptions.model_validate(options)).info


def test_serial_dac_leaves_room_for_feeding(tmp_path):
    """Four characters more in the sample period, where the experiment uses the watchdog."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER)
    bare, fed = serial_rates(path, "none"), serial_rates(path, {"timeout_s": 1.0})
    assert 1.0 / fed.max_rate_hz - 1.0 / bare.max_rate_hz == pytest.approx(4 * CHAR_S)
    assert "feed the watchdog" in fed.rate_note
    assert "to feed" not in bare.rate_note


def test_settling_is_told():
    """An M-7024's output takes 10 ms, and the note says so."""
    time = exchange_time(load_profile("icp_m7024_dcon"), "AO0", None)
    assert time.total_s - time.answered_s == pytest.approx(0.01)
    assert "settling 10.00 ms" in str(time)
