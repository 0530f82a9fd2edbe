"""Numbers in lines and frames: sent, recognised and read by one format."""

import re

import pytest

from hilctl_drivers.ascii.number_format import number_format, parse_number
from hilctl_drivers.transport import links


@pytest.mark.parametrize(("spec", "number", "text"), [
    ("+07.3f", -1.5, "-01.500"), (".2f,", -1.5, "-1.50"), ("8.3f", 1.5, "   1.500"),
    ("d", 3.0, "3"), ("X", 255.0, "FF"), ("04x", 255.0, "00ff"), ("int16", -2.0, "FF FE"),
    ("int16X", -2.0, "FFFE"), ("int32X DCBA", 1.0, "01000000"), ("", 0.25, "0.25"),
])  # fmt: skip
def test_sent_numbers_are_read_back(spec, number, text):
    form = number_format(spec)
    text = text.replace(".", form.mark or ".")
    assert form.text(number) == text
    assert re.fullmatch(form.regex, text)
    assert form.number(text) == number


@pytest.mark.parametrize(("spec", "number"), [("X", -1.0), ("02X", 256.0), ("int16X", 4e4)])
def test_a_format_never_clips(spec, number):
    with pytest.raises(links.BadRequestError):
        number_format(spec).text(number)


@pytest.mark.parametrize("spec", ["Q", "int24", "s", ".3f,,", "r", "4X", "X,"])
def test_unknown_formats(spec):
    with pytest.raises(ValueError, match="format of a number"):
        number_format(spec)


@pytest.mark.parametrize(("text", "mark", "value"), [
    ("- 1.25", ".", -1.25), ("+   0.5", ".", 0.5), ("-1,25", ",", -1.25), ("3", ",", 3.0),
])  # fmt: skip
def test_blanks_after_a_sign_and_decimal_commas(text, mark, value):
    assert parse_number(text, mark) == value


@pytest.mark.parametrize(
    ("text", "mark"), [("1.25", ","), ("1,25", "."), ("1,2,5", ","), ("- - 1", ".")]
)
def test_other_marks_are_no_numbers(text, mark):
    with pytest.raises(links.CorruptError):
        parse_number(text, mark)
