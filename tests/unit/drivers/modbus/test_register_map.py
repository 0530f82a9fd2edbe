"""Register bytes: vendors' own examples, the ends of each range, and what does not fit."""

import math

import pytest

from hilctl_drivers.modbus.register_map import Channel, Register, RegisterFormat, wire_address
from hilctl_drivers.transport.links import BadRequestError, FrameError, MismatchError


def test_labjack_word_order_self_test():
    """LabJack's TEST register is 0x00112233: low word first it would read 0x22330011."""
    wire = bytes.fromhex("00112233")
    assert RegisterFormat("uint32").decode(wire) == 0x00112233
    assert RegisterFormat("uint32", "CDAB").decode(wire) == 0x22330011


def test_labjack_float_default():
    """LabJack's TEST_FLOAT32 has the default -9999.0: C6 1C 3C 00, big-endian."""
    assert RegisterFormat("float32").encode(-9999.0) == bytes.fromhex("C61C3C00")


@pytest.mark.parametrize(("volts", "raw"), [(10.0, 0x7FFF), (-10.0, 0x8001), (0.0, 0x0000)])
def test_wago_full_scale(volts, raw):
    """WAGO 750-556: int16 0x8001 to 0x7FFF is -10 V to +10 V."""
    channel = RegisterFormat("int16", "AB", 10.0 / 32767)
    assert channel.encode(volts) == raw.to_bytes(2, "big")
    assert channel.decode(raw.to_bytes(2, "big")) == pytest.approx(volts, abs=1e-12)


def test_waveshare_microampere():
    """Waveshare Analog Output 8CH: 1 mA is 1000, 03 E8."""
    channel = RegisterFormat("uint16", scale=1e-6)
    assert channel.encode(1e-3) == bytes.fromhex("03E8")
    assert channel.decode(bytes.fromhex("03E8")) == pytest.approx(1e-3, rel=1e-15)


def test_offset_binary_of_a_bipolar_range():
    """Offset binary across -10 V to +10 V: 0 V in the middle, both ends exact."""
    channel = RegisterFormat("uint16", scale=20.0 / 65535, offset=-10.0)
    assert channel.encode(-10.0) == b"\0\0"
    assert channel.encode(10.0) == b"\xff\xff"
    assert channel.limits == pytest.approx((-10.0, 10.0))
    assert channel.encode(channel.offset + 0x8000 * channel.scale) == b"\x80\0"


@pytest.mark.parametrize(("kind", "low", "high"), [
    ("int16", -(2**15), 2**15 - 1),
    ("uint16", 0, 2**16 - 1),
    ("int32", -(2**31), 2**31 - 1),
    ("uint32", 0, 2**32 - 1),
])  # fmt: skip
def test_integers_reach_their_ends_and_no_further(kind, low, high):
    channel = RegisterFormat(kind)
    assert channel.limits == (low, high)
    assert [channel.decode(channel.encode(v)) for v in (low, high)] == [low, high]
    for value in (low - 1, high + 1, 1e300, -1e300):
        with pytest.raises(BadRequestError, match=f"{kind} register holds"):
            channel.encode(value)


def test_integers_round_half_to_even():
    """2.5 steps are 2, 3.5 steps are 4; half a step past the end is past the end."""
    channel = RegisterFormat("int16")
    assert [channel.decode(channel.encode(v)) for v in (2.5, 3.5, -2.5, 0.4999)] == [2, 4, -2, 0]
    assert channel.encode(32767.4) == b"\x7f\xff"
    with pytest.raises(BadRequestError):
        channel.encode(32767.5)


def test_float32_refuses_what_only_a_double_holds():
    """3.5e38 is past float32; its largest number is not."""
    largest = (2 - 2**-23) * 2.0**127
    channel = RegisterFormat("float32")
    assert channel.decode(channel.encode(largest)) == largest
    assert channel.limits == (-largest, largest)
    with pytest.raises(BadRequestError, match=r"float32 .* 3\.5e\+38"):
        channel.encode(3.5e38)


@pytest.mark.parametrize("kind", ["int16", "uint16", "int32", "uint32", "float32", "float64"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nothing_that_is_not_a_number_is_sent(kind, value):
    with pytest.raises(BadRequestError, match="cannot hold"):
        RegisterFormat(kind).encode(value)


def test_scaling_past_the_doubles_is_refused():
    with pytest.raises(BadRequestError, match="cannot hold"):
        RegisterFormat("float64", scale=1e-300).encode(1e300)


def test_negative_scale_turns_the_limits_round():
    assert RegisterFormat("int16", scale=-2.0, offset=1.0).limits == (-65533.0, 65537.0)


def test_a_device_that_sends_not_a_number_is_not_hidden():
    """Decoding passes on not a number; it is the loop that decides about a bad reading."""
    assert math.isnan(RegisterFormat("float32").decode(bytes.fromhex("7FC00000")))


@pytest.mark.parametrize("size", [0, 1, 3, 5, 8])
def test_decoding_wants_exactly_its_bytes(size):
    for order in ("", "CDAB", "DCBA"):
        with pytest.raises(MismatchError, match=r"float32 .*4 bytes"):
            RegisterFormat("float32", order).decode(bytes(size))


@pytest.mark.parametrize(("arguments", "rule"), [
    (("int32", "AB"), "each of ABCD once"),
    (("int32", "ABCC"), "each of ABCD once"),
    (("int16", "ABCD"), "each of AB once"),
    (("int32", "abcd"), "each of ABCD once"),
    (("int16", "AB", 0.0), "scale"),
    (("int16", "AB", math.nan), "scale"),
    (("int16", "AB", 1.0, math.inf), "offset"),
])  # fmt: skip
def test_formats_that_make_no_sense_are_refused(arguments, rule):
    with pytest.raises(BadRequestError, match=rule) as caught:
        RegisterFormat(*arguments)
    assert isinstance(caught.value, FrameError)
    assert isinstance(caught.value, ValueError)


def test_size_and_order_left_out():
    channel = RegisterFormat("float64")
    assert (channel.size, channel.order) == (8, "ABCDEFGH")
    assert not channel.is_integer
    assert RegisterFormat("uint16").is_integer
    assert RegisterFormat("int32", "ABCD") == RegisterFormat("int32")


VOLTS = {"address": 1, "unit": "V", "min": -10.0, "max": 10.0}


@pytest.mark.parametrize(("area", "address", "base", "wire"), [
    ("holding", 0, 0, 0),
    ("holding", 1, 1, 0),
    ("holding", 0, 1, -1),
    ("holding", 40001, "modicon", 0),
    ("holding", 49999, "modicon", 9998),
    ("holding", 400001, "modicon", 0),
    ("holding", 465536, "modicon", 65535),
    ("holding", 30001, "modicon", -1),
    ("input", 30011, "modicon", 10),
    ("coil", 1, "modicon", 0),
])  # fmt: skip
def test_addresses_are_those_of_the_frame(area, address, base, wire):
    """-1 where there is none."""
    kind = "bit" if area == "coil" else "uint16"
    assert wire_address(Register(area=area, address=address, type=kind), base) == wire


def test_a_channel_s_range_is_inside_its_raw_codes():
    """Twelve bits in the upper part of a word: what is put out is a multiple of 16 codes."""
    dac = Channel(**VOLTS, type="int16", scale=0.0003051944, ignored_low_bits=4)
    assert dac.step == pytest.approx(16 * 0.0003051944)
    assert dac.raw_limits == (-32768.0, 32767.0)


def test_an_inverted_scale_keeps_low_below_high():
    channel = Channel(**VOLTS, type="int16", scale=-0.001)
    assert channel.representable == pytest.approx((-32.767, 32.768))
