"""Registers in a profile: addresses as vendors write them, and values that fit."""

import pytest
from pydantic import ValidationError

from hilctl_drivers.modbus.register_map import Channel, Register, TripFlag, WriteStep, wire_address

VOLTS = {"address": 1, "unit": "V", "min": -10.0, "max": 10.0}


@pytest.mark.parametrize(
    ("area", "address", "base", "wire"),
    [
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
    ],
)
def test_addresses_are_those_of_the_frame(area, address, base, wire):
    """-1 where there is none."""
    kind = "bit" if area == "coil" else "uint16"
    assert wire_address(Register(area=area, address=address, type=kind), base) == wire


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"area": "coil", "type": "uint16"}, "type must be bit in area coil"),
        ({"type": "bit"}, "type must not be bit in area holding"),
        ({"area": "coil", "type": "bit", "scale": 2.0}, "a bit has no order, scale or offset"),
    ],
)
def test_bits_are_bits(given, said):
    with pytest.raises(ValidationError, match=said):
        Register(address=1, **given)


def test_a_channel_s_range_is_inside_its_raw_codes():
    """Twelve bits in the upper part of a word: what is put out is a multiple of 16 codes."""
    dac = Channel(**VOLTS, type="int16", scale=0.0003051944, ignored_low_bits=4)
    assert dac.step == pytest.approx(16 * 0.0003051944)
    assert dac.raw_limits == (-32768.0, 32767.0)
    with pytest.raises(ValidationError, match="must be inside what the register holds"):
        Channel(**VOLTS, type="int16", scale=0.0003051944, raw_max=20000)
    with pytest.raises(ValidationError, match="raw_min and raw_max are for whole-number types"):
        Channel(**VOLTS, type="float32", raw_max=20000)


def test_an_inverted_scale_keeps_low_below_high():
    channel = Channel(**VOLTS, type="int16", scale=-0.001)
    assert channel.representable == pytest.approx((-32.767, 32.768))


def test_steps_and_masks_fit_their_register():
    step = {"kind": "write", "address": 1, "type": "uint16"}
    assert WriteStep(**step, value="timeout").value == "timeout"
    with pytest.raises(ValidationError, match="value must fit into uint16, got 65536"):
        WriteStep(**step, value=65536.0)
    with pytest.raises(ValidationError, match="mask must fit into uint16, got 0x10000"):
        TripFlag(address=1, type="uint16", mask=0x10000)
