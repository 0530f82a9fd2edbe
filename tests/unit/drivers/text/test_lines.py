"""Lines of text: bytes as in the vendors' documents, and every answer mapped to what it means."""

import math

import pytest

from hilctl_drivers.text.lines import (
    LineFormat,
    dcon_answer,
    fixed_number,
    gen_answer,
    parse_fixed_number,
    parse_number,
    scpi_error,
    tenths_hex,
)
from hilctl_drivers.wire.errors import (
    BadRequest,
    Corrupt,
    Incomplete,
    Mismatch,
    Refused,
    WatchdogTripped,
)

PLAIN = LineFormat()
DCON = LineFormat(checksum="dcon")
GEN = LineFormat(checksum="gen")
SCPI = LineFormat(b"\n", size_max=127)
ALL = pytest.mark.parametrize("line", [PLAIN, DCON, GEN, SCPI, LineFormat(b"\r\n")], ids=str)


def test_dcon_output_as_in_the_manual():
    """ICP DAS, #AAN(Data): +5.0 to channel 2 of module 01 is "#012+05.000", answered by ">"."""
    command = "#012" + fixed_number(5.0, 2, 3)
    assert PLAIN.encode(command) == b"#012+05.000\r"
    assert dcon_answer(command, PLAIN.decode(b">\r")) == ""


def test_dcon_watchdog_as_in_the_manual():
    """ICP DAS, ~AA3EVV: "~013164" enables the host watchdog of module 01 with 10.0 s."""
    command = "~0131" + tenths_hex(10.0)
    assert PLAIN.encode(command) == b"~013164\r"
    assert dcon_answer(command, "!01") == ""


def test_dcon_checksum_as_in_the_manual():
    """ICP DAS, "Checksum Calculation": $012B7 asks, !01200600AA answers."""
    assert DCON.encode("$012") == b"$012B7\r"
    assert DCON.decode(b"!01200600AA\r") == "!01200600"
    assert dcon_answer("$012", "!01200600") == "200600"


def test_dcon_reading_as_in_the_manual():
    """ICP DAS ZT-2017, #AAN: "#032" is answered by ">+025.13"; "#039" by "?03"."""
    assert parse_fixed_number(dcon_answer("#032", ">+025.13"), 3, 2) == 25.13
    with pytest.raises(Refused, match="#039: invalid command") as caught:
        dcon_answer("#039", "?03")
    assert caught.value.code == "?03"


def test_dcon_bare_exclamation_mark_is_a_tripped_watchdog():
    """It is an error of its own: the output is at its safe value and commands do nothing."""
    with pytest.raises(WatchdogTripped, match="output is at its safe value") as caught:
        dcon_answer("#010+01.000", "!")
    assert caught.value.code == "!"


def test_dcon_question_mark_is_out_of_range():
    """The module has put out the end of its range, which is not what was asked."""
    with pytest.raises(Refused, match="out of range") as caught:
        dcon_answer("#010+11.000", "?")
    assert not isinstance(caught.value, WatchdogTripped)
    assert caught.value.code == "?"


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("#010+01.000", "!01"),
        ("#010+01.000", ""),
        ("#010+01.000", "?02"),
        ("#010+01.000", "+01.000"),
        ("$012", ">"),
        ("$012", "!02200600"),
        ("~010", "!0"),
        ("%0102200600", "!03"),
    ],
)
def test_dcon_answers_to_something_else(command, reply):
    """Another module's, another command's or no answer at all is not taken for success."""
    with pytest.raises(Mismatch, match="not an answer"):
        dcon_answer(command, reply)


@pytest.mark.parametrize("reply", ["!01", "!02"])
def test_dcon_configuration_answers_from_old_or_new_address(reply):
    """%AANN... changes the address from 01 to 02."""
    assert dcon_answer("%0102200600", reply) == ""


def test_gen_lines_as_in_the_manual():
    """TDK-Lambda Genesys 4.9.4: STT?$3A and STAT?$7B; "OK" acknowledges."""
    assert GEN.encode("STT?") == b"STT?$3A\r"
    assert GEN.encode("STAT?") == b"STAT?$7B\r"
    assert gen_answer(GEN.decode(GEN.encode("OK"))) == "OK"
    assert parse_number(gen_answer("012.50")) == 12.5


@pytest.mark.parametrize(
    ("reply", "meaning"),
    [("C01", "illegal command"), ("C05", "out of range"), ("E01", "above"), ("E99", "not in the")],
)
def test_gen_errors_say_what_they_mean(reply, meaning):
    """Error messages of the manual's tables 8-1 and 8-2."""
    with pytest.raises(Refused, match=meaning) as caught:
        gen_answer(reply)
    assert caught.value.code == reply


def test_scpi_lines():
    """A query, its number and an empty error queue."""
    assert SCPI.encode("MEAS:CURR?") == b"MEAS:CURR?\n"
    assert parse_number(SCPI.decode(b"-1.25E-3\n")) == -1.25e-3
    scpi_error('0,"No error"')
    scpi_error('+0,"No error"')


def test_scpi_error_carries_number_and_text():
    """SCPI-1999 21.8.11: -222 is a value out of range."""
    with pytest.raises(Refused, match="error -222: Data out of range; CURR 99") as caught:
        scpi_error('-222,"Data out of range; CURR 99"')
    assert caught.value.code == -222


@pytest.mark.parametrize(
    "reply", ["", "0", "No error", "0,No error", '0,"No error', '"No error"', '0,"No error",1']
)
def test_scpi_error_of_another_form_is_no_success(reply):
    """Only number and quoted text can say that there was no error."""
    with pytest.raises(Corrupt, match="must be number"):
        scpi_error(reply)


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
    with pytest.raises(Corrupt):
        parse_number(text)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (5.0, (2, 3), "+05.000"),
        (-9.9996, (2, 3), "-10.000"),
        (0.0, (2, 3), "+00.000"),
        (-0.0, (2, 3), "+00.000"),
        (-0.0004, (2, 3), "+00.000"),
        (-99.9994, (2, 3), "-99.999"),
        (12.0, (3, 0), "+012"),
        (19.999, (2, 3), "+19.999"),
    ],
)
def test_fixed_numbers_fill_their_field(value, digits, text):
    """Sign, leading zeros, decimals; zero is positive."""
    assert fixed_number(value, *digits) == text
    assert parse_fixed_number(text, *digits) == pytest.approx(value, abs=0.5 * 10 ** -digits[1])


@pytest.mark.parametrize("value", [100.0, -100.0, 99.9996, 1e300, math.nan, math.inf, -math.inf])
def test_numbers_that_do_not_fit_the_field_are_refused(value):
    """Nothing is cut or clipped, rounding up past the field included."""
    with pytest.raises(BadRequest, match=r"does not fit the field \+00\.000"):
        fixed_number(value, 2, 3)


@pytest.mark.parametrize(
    "text", ["+9999", "05.000", "+5.000", "+05.0000", " 05.000", "", "+05,000"]
)
def test_fields_of_another_form_are_corrupt(text):
    """An input out of range sends +9999, which is no reading."""
    with pytest.raises(Corrupt):
        parse_fixed_number(text, 2, 3)


@pytest.mark.parametrize(("seconds", "text"), [(0.1, "01"), (1.0, "0A"), (25.5, "FF"), (0.7, "07")])
def test_tenths_of_a_second_in_hex(seconds, text):
    """The whole range of the DCON watchdog."""
    assert tenths_hex(seconds) == text


@pytest.mark.parametrize("seconds", [0.0, 0.04, 0.25, 25.6, -1.0, math.nan, math.inf])
def test_times_that_the_watchdog_cannot_keep_are_refused(seconds):
    """Neither rounded nor clipped: 0.25 s would be another time-out."""
    with pytest.raises(BadRequest, match=r"steps of 0\.1 s"):
        tenths_hex(seconds)


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
    with pytest.raises(BadRequest, match="printable ASCII"):
        line.encode(text)


def test_long_lines_are_refused_both_ways():
    """Kepco takes 127 characters; a receiver never waits for more than a line can have."""
    assert len(SCPI.encode("x" * 127)) == 128
    with pytest.raises(BadRequest, match="at most 127 bytes, got 128"):
        SCPI.encode("x" * 128)
    with pytest.raises(Corrupt, match="at most 127 bytes, got 128"):
        SCPI.decode(b"x" * 128 + b"\n")
    with pytest.raises(Corrupt, match="must be one line"):
        SCPI.decode(b"x" * 128)
    assert DCON.size_max == 255
    with pytest.raises(BadRequest, match="got 256"):
        DCON.encode("x" * 254)


@ALL
def test_beginnings_and_tails_of_lines(line):
    """A line without its end is incomplete; anything behind its end is corrupt."""
    whole = line.encode("OK")
    for cut in range(len(whole)):
        with pytest.raises(Incomplete):
            line.decode(whole[:cut])
    for tail in (b"x", whole, line.terminator):
        with pytest.raises(Corrupt, match="must be one line"):
            line.decode(whole + tail)


@pytest.mark.parametrize("body", [b"\xb0", b"a\tb", b"\x7f", b"\x11OK", b"OK\r"])
def test_what_is_not_text_is_corrupt(body):
    """Flow control, eighth bits and a terminator of another kind."""
    with pytest.raises(Corrupt, match="printable ASCII"):
        SCPI.decode(body + b"\n")


@pytest.mark.parametrize(
    ("line", "wire"),
    [(DCON, b">3F\r"), (DCON, b">\r"), (DCON, b">3e\r"), (DCON, b"\r"), (DCON, b"!01200600aa\r"),
     (GEN, b"OK\r"), (GEN, b"OK$9B\r"), (GEN, b"OK9A\r"), (GEN, b"$9\r")],
)  # fmt: skip
def test_wrong_or_missing_checksums_are_corrupt(line, wire):
    """One off, in small letters, cut or not there at all."""
    with pytest.raises(Corrupt, match="checksum"):
        line.decode(wire)


def test_line_formats_that_make_no_sense():
    """A printable terminator would end lines in the middle."""
    for terminator in (b"", b";", b"\r;"):
        with pytest.raises(BadRequest, match="control characters"):
            LineFormat(terminator)
    with pytest.raises(BadRequest, match="unknown line checksum 'lrc'; known are none, dcon, gen"):
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
        assert isinstance(out[1], Corrupt)
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
    assert PLAIN.splitter().feed(b"\rOK\r\r") == ["", "OK", ""]
