"""Lines of text: bytes as in the vendors' documents, numbers, and lines out of a stream."""

import pytest

from hilctl_drivers.ascii.lines import LineFormat, parse_number
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

PLAIN = LineFormat()
DCON = LineFormat(checksum="dcon")
GEN = LineFormat(checksum="gen")
SCPI = LineFormat(b"\n", size_max=127)
ALL = pytest.mark.parametrize("line", [PLAIN, DCON, GEN, SCPI, LineFormat(b"\r\n")], ids=str)


def test_dcon_checksum_as_in_the_manual():
    """ICP DAS, "Checksum Calculation": $012B7 asks, !01200600AA answers."""
    assert DCON.encode("$012") == b"$012B7\r"
    assert DCON.decode(b"!01200600AA\r") == "!01200600"


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
    assert DCON.size_max == 255
    with pytest.raises(BadRequestError, match="got 256"):
        DCON.encode("x" * 254)


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
    [(DCON, b">3F\r"), (DCON, b">\r"), (DCON, b">3e\r"), (DCON, b"\r"), (DCON, b"!01200600aa\r"),
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
    assert PLAIN.splitter().feed(b"\rOK\r\r") == ["", "OK", ""]
