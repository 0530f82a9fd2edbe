"""Asking a device in lines of text: templates out, patterns back, trouble by its own name."""

import math
from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_profile import Reply
from hilctl_drivers.ascii.ascii_session import (
    AsciiSession,
    exchange_time,
)
from hilctl_drivers.ascii.message_format import FrameFormat, LineFormat, formats
from hilctl_drivers.ascii.number_format import parse_number
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.transport import links

DCON = load_profile(str(Path(__file__).parents[3] / "data" / "dcon_module.yaml"))
GOOD = Reply(pattern=">", example=">")
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
            raise links.NoAnswerError("no answer within 0.1 s")
        return reply


def session(*replies, profile=PLAIN, sleep=None):
    return AsciiSession(profile, ScriptedLink(*replies), 2, sleep or (lambda seconds: None))


def test_a_value_is_put_in_and_a_number_comes_out():
    asked = session(b">+05.123\r")
    assert asked.number(PLAIN.inputs["AI0"]) == 5.123
    assert asked.text(PLAIN.outputs["AO0"].write, value=-1.5) == "#020-01.500"
    assert asked.link.sent == [b"#020\r"]


def test_error_that_no_query_clears_is_refused():
    """A device that reports a state, not a queue."""
    asked = session(*[b"-350\n"] * 1000, profile=load_profile("pi_e727"))
    with pytest.raises(links.RefusedError):
        asked.old_errors()
    assert len(asked.link.sent) < 1000


@pytest.mark.parametrize(("reply", "error", "said"), [
    (b"?\r", links.RefusedError, r"#020: out of range \(\?\)"),
    (b"?02\r", links.RefusedError, "invalid command"),
    (b"!\r", links.WatchdogTrippedError, "ignored, the host watchdog has tripped"),
    (b"ok\r", links.MismatchError, ": 'ok'"),
    (b">>\r", links.MismatchError, ": '>>'"),
    (None, links.NoAnswerError, "#020: no answer within 0.1 s"),
])  # fmt: skip
def test_trouble_is_told_with_what_was_asked(reply, error, said):
    with pytest.raises(error, match=said):
        session(reply).ask("#020", GOOD)


def test_another_address_answers_for_nobody():
    with pytest.raises(links.MismatchError, match="address 03"):
        session(b"!037024\r").ask("$02M", PLAIN.selftest)


def test_a_line_is_waited_for_to_its_end_but_not_for_ever():
    asked = session(b">\r")
    asked.ask("#020", GOOD)
    missing = asked.link.missing
    assert (missing(bytearray(b">")), missing(bytearray(b">\r"))) == (1, 0)
    with pytest.raises(links.CorruptError, match="no end of"):
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
    session(b"!027024\r", profile=PLAIN).identify()
    with pytest.raises(DeviceError, match="'!027024', got '!024017'"):
        session(b"!024017\r").identify()


def test_another_end_of_line_names_its_key():
    for silent, keys in ((PLAIN, True), (load_profile("npoint_lc400"), False)):
        asked = session(None, profile=silent)
        with pytest.raises(links.NoAnswerError) as caught:
            asked.identify()
        assert ("link.reply_terminator" in str(caught.value)) == keys
    for reply, line in ((b"OK\r\n", SCPI), (b"OK\r\n", LineFormat(b"\r"))):
        with pytest.raises(links.CorruptError, match="reply_terminator"):
            line.decode(reply)


def test_an_echo_must_be_what_was_sent():
    link = PLAIN.link.model_copy(update={"echo": True})
    profile = PLAIN.model_copy(update={"link": link})
    session(b"#020\r>\r", profile=profile).ask("#020", GOOD)
    with pytest.raises(links.CorruptError, match="b'#030'"):
        session(b"#030\r>\r", profile=profile).ask("#020", GOOD)


def test_command_that_comes_back_in_place_of_its_reply_is_an_echo():
    with pytest.raises(links.MismatchError, match="echo: true"):
        session(b"#020\r").ask("#020", GOOD)


LINES = Reply(pattern=r"1=([0-9.]+) \n2=[0-9.]+", example="1=0.5 \n2=0.25")


def test_several_lines_are_one_write():
    asked = session(b"1=1.5 \r2=3\r")
    assert asked.ask("SVA 1 5\nPOS? 1 2", LINES)[1] == "1.5"
    assert asked.link.sent == [b"SVA 1 5\rPOS? 1 2\r"]
    assert asked.link.missing(bytearray(b"1=1.5 \r")) == 1


@pytest.mark.parametrize(("reply", "error"), [
    (b"1=1.5 \r?\r", links.RefusedError),
    (b"1=1.5 \r3=3\r", links.MismatchError),
    (b"1=1.5 \r2=3\r4", links.CorruptError),
    (None, links.NoAnswerError),
])  # fmt: skip
def test_each_line_of_a_reply_is_checked(reply, error):
    with pytest.raises(error) as caught:
        session(reply).ask("SVA 1 5\nPOS? 1 2", LINES)
    assert "\n" not in str(caught.value)


def test_an_echo_may_have_several_lines():
    link = PLAIN.link.model_copy(update={"echo": True})
    profile = PLAIN.model_copy(update={"link": link})
    asked = session(b"SVA 1 5\rPOS? 1\r>\r", b"a\rb\r", profile=profile)
    assert asked.ask("SVA 1 5\nPOS? 1", GOOD)[0] == ">"
    asked.send("a\nb")
    assert asked.link.missing(bytearray(b"a\r")) == 1


def wire_s(time):
    return time.request_s + time.reply_s


class TestText:
    def test_dcon(self):
        """#010+05.000 and > with their carriage returns are 14 characters."""
        profile = load_profile("icp_m7024_dcon")
        time = exchange_time(profile, "AO0", None)
        assert wire_s(time) == pytest.approx(14 * 10 / 9600)
        assert wire_s(exchange_time(with_link(profile, checksum="dcon"), "AO0", None)) == (
            pytest.approx(18 * 10 / 9600)
        )

    def test_lines_of_one_write(self):
        """SVA 1 100.0000, POS? 1 and 1=12.3456 with their line feeds; one turnaround."""
        profile = load_profile("pi_e709")
        time = exchange_time(profile, "axis1", "position1")
        assert wire_s(time) == pytest.approx((15 + 7 + 10) * 10 / 115200)
        assert time.turnaround_s == profile.turnaround_s

    def test_gap(self):
        """TDK-Lambda's 5 ms come once a line."""
        time = exchange_time(load_profile("tdk_lambda_gen"), "current", "current")
        assert (time.gaps, time.gaps_s) == (2, 0.01)
        assert time.request_s == pytest.approx((13 + 7) * 10 / 9600)  # PC 38.000$XX, MC?$XX
        assert time.reply_s == pytest.approx((6 + 10) * 10 / 9600)  # OK$XX, 05.003$XX

    def test_one_line(self):
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
    assert AsciiSession.feed_time(load_profile(name)) is None


def test_an_unanswered_line_costs_its_characters():
    time = AsciiSession.feed_time(load_profile("icp_m7024_dcon"))
    assert time.total_s == time.request_s == pytest.approx(len("~**\r") * 10 / 9600)


def test_settling_is_told():
    """An M-7024's output takes 10 ms, and the note says so."""
    time = exchange_time(load_profile("icp_m7024_dcon"), "AO0", None)
    assert time.total_s - time.answered_s == pytest.approx(0.01)
    assert "settling 10.00 ms" in str(time)


PLAIN_LINE = LineFormat()
DCON_LINE = LineFormat(checksum="dcon")
GEN = LineFormat(checksum="gen")
SCPI = LineFormat(b"\n", size_max=127)
ALL = pytest.mark.parametrize(
    "line", [PLAIN_LINE, DCON_LINE, GEN, SCPI, LineFormat(b"\r\n")], ids=str
)


@pytest.mark.parametrize(("line", "text", "wire"), [
    # ICP DAS, "Checksum Calculation"
    (DCON_LINE, "$012", b"$012B7\r"),
    (DCON_LINE, "!01200600", b"!01200600AA\r"),
    # TDK-Lambda Genesys 4.9.4
    (GEN, "STT?", b"STT?$3A\r"),
    (GEN, "STAT?", b"STAT?$7B\r"),
    (SCPI, "MEAS:CURR?", b"MEAS:CURR?\n"),
])  # fmt: skip
def test_lines_as_in_the_manuals(line, text, wire):
    assert line.encode(text) == wire
    assert line.decode(bytearray(wire)) == text


@pytest.mark.parametrize(
    ("text", "value"),
    [("1", 1.0), ("-1.5", -1.5), ("+.5", 0.5), ("5.", 5.0), ("1e3", 1e3), (" +1.0E-06 ", 1e-6),
     ("012.50", 12.5), ("-1.25E-3", -1.25e-3)],
)  # fmt: skip
def test_numbers_of_all_three_forms(text, value):
    """NR1, NR2 and NR3 of IEEE 488.2, with blanks around them."""
    assert parse_number(text) == value


@pytest.mark.parametrize(
    "text",
    ["", " ", "1,2", "1 2", "1.2.3", "nan", "inf", "1_000", "0x10", "+-1", "e5", ".", "1A", "1\n",
     "\u0661", "1e99999", "9.9E37", "-9.9e37", "9.91E37", "1e400"],
)  # fmt: skip
def test_what_is_not_exactly_one_number_is_corrupt(text):
    with pytest.raises(links.CorruptError):
        parse_number(text)


@ALL
@pytest.mark.parametrize("text", ["", "a\r", "\n", "a\tb", "µm", "a\0", "\x7f"])
def test_only_printable_lines_are_sent(line, text):
    with pytest.raises(links.BadRequestError, match="printable ASCII"):
        line.encode(text)


def test_long_lines_are_refused_both_ways():
    """Kepco takes 127 characters; a receiver never waits for more than a line can have."""
    assert len(SCPI.encode("x" * 127)) == 128
    with pytest.raises(links.BadRequestError, match="127 bytes, got 128"):
        SCPI.encode("x" * 128)
    with pytest.raises(links.CorruptError, match="127 bytes, got 128"):
        SCPI.decode(b"x" * 128 + b"\n")
    with pytest.raises(links.CorruptError, match="one line"):
        SCPI.decode(b"x" * 128)
    assert DCON_LINE.size_max == 255
    with pytest.raises(links.BadRequestError, match="got 256"):
        DCON_LINE.encode("x" * 254)


@ALL
def test_beginnings_and_tails_of_lines(line):
    whole = line.encode("OK")
    for cut in range(len(whole)):
        with pytest.raises(links.CorruptError, match="one line"):
            line.decode(whole[:cut])
    for tail in (b"x", whole, line.terminator):
        with pytest.raises(links.CorruptError, match="one line"):
            line.decode(whole + tail)


@pytest.mark.parametrize("body", [b"\xb0", b"a\tb", b"\x7f", b"\x11OK", b"OK\r"])
def test_what_is_not_text_is_corrupt(body):
    with pytest.raises(links.CorruptError, match="printable ASCII"):
        SCPI.decode(body + b"\n")


@pytest.mark.parametrize(
    ("line", "wire"),
    [(DCON_LINE, b">3F\r"), (DCON_LINE, b">\r"), (DCON_LINE, b">3e\r"), (DCON_LINE, b"\r"),
     (DCON_LINE, b"!01200600aa\r"),
     (GEN, b"OK\r"), (GEN, b"OK$9B\r"), (GEN, b"OK9A\r"), (GEN, b"$9\r")],
)  # fmt: skip
def test_wrong_or_missing_checksums_are_corrupt(line, wire):
    with pytest.raises(links.CorruptError, match="checksum"):
        line.decode(wire)


def test_stream_of_lines_skips_bad_ones_and_passes_on_empty_ones():
    """A line that is too long is bad; the incomplete last one stays."""
    received = bytearray(b"x" * 30 + b"\r\ngood\r\n\r\nincomplete\r")
    assert list(LineFormat(b"\r\n", size_max=20).messages(received)) == ["good", ""]
    assert received == b"incomplete\r"


@pytest.mark.parametrize(("reply", "value"), [
    (b">+05.123\r", 5.123), (b">+99.999\r", math.nan), (b">OVL\r", math.nan),
])  # fmt: skip
def test_reply_that_marks_a_reading_as_invalid(reply, value):
    invalid = Reply(pattern=r">(\+99\.999|OVL)", example=">OVL")
    source = PLAIN.inputs["AI0"].model_copy(update={"invalid": invalid})
    assert session(reply).value(source) == pytest.approx(value, nan_ok=True)


def test_a_refusal_is_no_invalid_reading():
    invalid = Reply(pattern=">OVL", example=">OVL")
    source = PLAIN.inputs["AI0"].model_copy(update={"invalid": invalid})
    with pytest.raises(links.RefusedError):
        session(b"?02\r").value(source)


NPOINT = load_profile("npoint_lc400")


@pytest.mark.parametrize(("reply", "counts"), [
    # Captured from a controller
    ("a0341383110401000055", 260), ("a03413831112ffffff55", -238), ("a034138311f003000055", 1008),
])  # fmt: skip
def test_frames_as_captured(reply, counts):
    asked = session(bytes.fromhex(reply), profile=NPOINT)
    assert asked.number(NPOINT.inputs["position1"]) == counts
    assert asked.link.sent == [bytes.fromhex("a03413831155")]
    assert [asked.link.missing(bytearray(n)) for n in (0, 9, 10)] == [10, 1, 0]


@pytest.mark.parametrize("reply", ["a0342383110401000055", "a0341383110401000054", "a034138311"])
def test_a_frame_must_match_its_pattern(reply):
    with pytest.raises(links.MismatchError):
        session(bytes.fromhex(reply), profile=NPOINT).number(NPOINT.inputs["position1"])


def test_frames_of_one_write():
    asked = session(bytes.fromhex("a0341383110401000055"), profile=NPOINT)
    combined = NPOINT.exchange
    asked.ask(asked.text(combined.write, value=1000.0), combined)
    assert asked.link.sent == [bytes.fromhex("a03413831155a218128311e803000055")]
    time = exchange_time(NPOINT, "axis1", "position1")
    assert time.what == "2 frames at 115200 8N1"
    assert wire_s(time) == pytest.approx((10 + 6 + 10) * 10 / 115200)


@pytest.mark.parametrize(("checksum", "wire"), [
    # BK Precision 1785B: remote control on, address 0, in 26 bytes; CRC-16/MODBUS of 01 03
    ("sum8", "aa002001" + "00" * 21 + "cb"), ("crc16_modbus", "01034021"), ("none", "aa55"),
])  # fmt: skip
def test_checksums_of_frames(checksum, wire):
    link = NPOINT.link.model_copy(update={"checksum": checksum})
    request, reply = formats(link)
    assert isinstance(reply, FrameFormat)
    data = bytes.fromhex(wire)
    text = reply.decode(data)
    assert request.encode(text) == data
    assert len(request.wire(f"{text}\n{text}")) == 2 * len(data)
    if reply.check.size:
        with pytest.raises(links.CorruptError):
            reply.decode(b"\1" + data[1:-1] + b"\2")
