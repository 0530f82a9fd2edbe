"""Bytes with fixed bits: those of the optoNCDT 1420 (three sixes) and 1402 (two sevens)."""

import pytest

from hilctl_drivers.sensor_stream.bits import BitFormat, bits_of, bits_regex
from hilctl_drivers.transport.links import BadRequestError

SIXES = "00...... 01...... 10......"


def test_numbers_as_in_the_manuals():
    """Operating Instructions of the optoNCDT 1420, 8.2, and of the 1402, 8.1.1."""
    value = 0b10_000011_000101_001001
    form = BitFormat(SIXES, "CBA")
    data = bytes([0b00_001001, 0b01_000101, 0b10_000011])
    assert form.decode(data) == value & 0x3FFFF
    assert form.encode(form.decode(data)) == data
    sevens = BitFormat("1....... 0.......")
    assert sevens.decode(bytes([0x80 | 0x10, 0x33])) == 0x10 << 7 | 0x33
    assert sevens.limits == (0.0, 2**14 - 1)


@pytest.mark.parametrize("value", [-1.0, 2.0**18])
def test_a_value_that_does_not_fit(value):
    with pytest.raises(BadRequestError):
        BitFormat(SIXES, "CBA").encode(value)


def test_an_order_names_each_byte():
    with pytest.raises(BadRequestError, match="ABC"):
        BitFormat(SIXES, "BA")


@pytest.mark.parametrize(("text", "good", "bad"), [
    ("MEAS", b"MEAS", b"MEAN"), ("AA 55", b"\xaa\x55", b"\xaa\x54"), ("AB", b"\xab", b"AB"),
    (SIXES, b"\n\x7f\x80", b"\n\n\x80"),
])  # fmt: skip
def test_beginnings_in_three_notations(text, good, bad):
    regex = bits_regex(bits_of(text))
    assert regex.fullmatch(good)
    assert not regex.fullmatch(bad)
