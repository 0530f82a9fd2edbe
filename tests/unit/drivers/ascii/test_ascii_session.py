"""Asking a device in lines of text: templates out, patterns back, trouble by its own name."""

from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_dac import AsciiDac
from hilctl_drivers.ascii.ascii_session import (
    AsciiSession,
    LineFormat,
    exchange_time,
    feed_time,
    parse_number,
)
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.serial_dac import SerialOptions
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    IncompleteError,
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


PLAIN_LINE = LineFormat()
DCON_LINE = LineFormat(checksum="dcon")
GEN = LineFormat(checksum="gen")
SCPI = LineFormat(b"\n", size_max=127)
ALL = pytest.mark.parametrize(
    "line", [PLAIN_LINE, DCON_LINE, GEN, SCPI, LineFormat(b"\r\n")], ids=str
)


def test_dcon_checksum_as_in_the_manual():
    """ICP DAS, "Checksum Calculation": $012B7 asks, !01200600AA answers."""
    assert DCON_LINE.encode("$012") == b"$012B7\r"
    assert DCON_LINE.decode(b"!01200600AA\r") == "!01200600"


def test_gen_lines_as_in_the_manual():
    """TDK-Lambda Genesys 4.9.4: STT?$3A and STAT?$7B; "OK" acknowledges."""
    assert GEN.encode("STT?") == b"STT?$3A\r"
    assert GEN.encode("STAT?") == b"STAT?$7B\r"
    assert GEN.decode(GEN.encode("OK")) == "OK"
    assert parse_number("012.50") == 12.5


def test_scpi_lines():
    """A query and its number."""
    assert SCPI.encode("MEAS:CURR?") == b"MEAS:CURR?\n"
    assert parse_number(SCPI.decode(b"-1.25E-3\n")) == -1.25e-3


@pytest.mark.parametrize(
    ("text", "value"),
    [("1", 1.0), ("-1.5", -1.5), ("+.5", 0.5), ("5.", 5.0), ("1e3", 1e3), (" +1.0E-06 ", 1e-6)],
)
def test_numbers_of_all_three_forms(text, value):
    """NR1, NR2 and NR3 of IEEE 488.2, with blanks around them."""
    assert parse_number(text) == value


@pytest.mark.parametrize(
    "text",
    ["", " ", "1,2", "1 2", "1.2.3", "nan", "inf", "1_000", "0x10", "+-1", "e5", ".", "1A", "1\n",
     "\u0661", "1e99999", "9.9E37", "-9.9e37", "9.91E37", "1e400"],
)  # fmt: skip
def test_what_is_not_exactly_one_number_is_corrupt(text):
    """Two numbers, units, Python's own spellings and SCPI's marks for no number."""
    with pytest.raises(CorruptError):
        parse_number(text)


@ALL
def test_lines_come_back(line):
    """Encode, then decode, for each terminator and checksum."""
    for text in ("A", "CURR 1.5", "~", " x ", "$$$"):
        assert line.decode(line.encode(text)) == text
        assert line.decode(bytearray(line.encode(text))) == text


@ALL
@pytest.mark.parametrize("text", ["", "a\r", "\n", "a\tb", "µm", "a\0", "\x7f"])
def test_only_printable_lines_are_sent(line, text):
    """Control characters could end the line early; others have no ASCII code."""
    with pytest.raises(BadRequestError, match="printable ASCII"):
        line.encode(text)


def test_long_lines_are_refused_both_ways():
    """Kepco takes 127 characters; a receiver never waits for more than a line can have."""
    assert len(SCPI.encode("x" * 127)) == 128
    with pytest.raises(BadRequestError, match="127 bytes, got 128"):
        SCPI.encode("x" * 128)
    with pytest.raises(CorruptError, match="127 bytes, got 128"):
        SCPI.decode(b"x" * 128 + b"\n")
    with pytest.raises(CorruptError, match="one line"):
        SCPI.decode(b"x" * 128)
    assert DCON_LINE.size_max == 255
    with pytest.raises(BadRequestError, match="got 256"):
        DCON_LINE.encode("x" * 254)


@ALL
def test_beginnings_and_tails_of_lines(line):
    """A line without its end is incomplete; anything behind its end is corrupt."""
    whole = line.encode("OK")
    for cut in range(len(whole)):
        with pytest.raises(IncompleteError):
            line.decode(whole[:cut])
    for tail in (b"x", whole, line.terminator):
        with pytest.raises(CorruptError, match="one line"):
            line.decode(whole + tail)


@pytest.mark.parametrize("body", [b"\xb0", b"a\tb", b"\x7f", b"\x11OK", b"OK\r"])
def test_what_is_not_text_is_corrupt(body):
    """Flow control, eighth bits and a terminator of another kind."""
    with pytest.raises(CorruptError, match="printable ASCII"):
        SCPI.decode(body + b"\n")


@pytest.mark.parametrize(
    ("line", "wire"),
    [(DCON_LINE, b">3F\r"), (DCON_LINE, b">\r"), (DCON_LINE, b">3e\r"), (DCON_LINE, b"\r"),
     (DCON_LINE, b"!01200600aa\r"),
     (GEN, b"OK\r"), (GEN, b"OK$9B\r"), (GEN, b"OK9A\r"), (GEN, b"$9\r")],
)  # fmt: skip
def test_wrong_or_missing_checksums_are_corrupt(line, wire):
    """One off, in small letters, cut or not there at all."""
    with pytest.raises(CorruptError, match="checksum"):
        line.decode(wire)


def test_line_formats_that_make_no_sense():
    """A printable terminator would end lines in the middle."""
    for terminator in (b"", b";", b"\r;"):
        with pytest.raises(BadRequestError, match="control characters"):
            LineFormat(terminator)
    with pytest.raises(BadRequestError, match=r"'lrc'.* none, dcon, gen"):
        LineFormat(checksum="lrc")


@ALL
def test_stream_of_lines_in_any_pieces(line):
    """Lines and a corrupt one in their order, whatever the pieces."""
    stream = line.encode("one") + b"\xff" + line.terminator + line.encode("two") + line.encode("3")
    for piece in (1, 2, 5, len(stream)):
        splitter = line.splitter()
        out = [
            each
            for at in range(0, len(stream), piece)
            for each in splitter.feed(stream[at : at + piece])
        ]
        assert [each for each in out if isinstance(each, str)] == ["one", "two", "3"]
        assert isinstance(out[1], CorruptError)
        assert len(out) == 4


def test_stream_of_lines_after_noise_without_end():
    """Noise is reported once and does not grow; the line after the next terminator is good."""
    line = LineFormat(b"\r\n", size_max=20)
    splitter = line.splitter()
    out = [each for _ in range(50) for each in splitter.feed(b"noise")]
    assert len(out) == 1
    assert splitter.feed(b"\r") == []
    assert splitter.feed(b"\ngood\r\n") == ["good"]


def test_stream_of_lines_finds_an_end_cut_in_two_by_noise():
    """The first byte of an end that came with too much noise is not thrown away with it."""
    splitter = LineFormat(b"\r\n", size_max=20).splitter()
    assert len(splitter.feed(b"x" * 30 + b"\r")) == 1
    assert splitter.feed(b"\ngood\r\n") == ["good"]


def test_stream_of_lines_passes_on_empty_lines():
    """An empty line is an answer, if a strange one."""
    assert PLAIN_LINE.splitter().feed(b"\rOK\r\r") == ["", "OK", ""]
