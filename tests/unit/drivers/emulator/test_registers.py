"""Registers of an emulated device: what can be read where, and who may write."""

import pytest

from hilctl_drivers.emulator.registers import RegisterMap, Words
from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.modbus.register_map import Register
from hilctl_drivers.profile import load_profile

FLOAT = Register(address=10, type="float32", order="CDAB")
BIT = Register(area="coil", address=3, type="bit")


def test_words_stand_for_a_value_in_the_register_s_own_order():
    words = Words(FLOAT)
    words.value = 1.5
    assert words.data == bytes.fromhex("0000 3fc0")
    assert words.value == 1.5
    bit = Words(BIT)
    bit.value = 7.0
    assert (bit.data, bit.value) == (b"\0\1", 1.0)


PROFILE = load_profile("labjack_t7")


@pytest.fixture
def t7():
    """The registers of a LabJack T7: outputs at 1000, inputs at 0."""
    return RegisterMap(PROFILE)


def test_all_of_a_value_is_written_or_nothing(t7):
    given = b"\0\1\0\2"
    ((target, data),) = t7.targets("holding", 1000, given)
    assert data == given
    target.data = data
    assert t7.read(["holding"], 1000, 2) == t7.written("holding", 1000, 2) == given
    for address, size in ((1000, 2), (1001, 2), (1000, 6)):
        with pytest.raises(RejectedRequest):
            t7.targets("holding", address, bytes(size))


def test_what_is_read_only_is_not_there_for_writes(t7):
    assert t7.read(["coil", "input"], 0, 2) == bytes(4)
    with pytest.raises(RejectedRequest):
        t7.targets("input", 0, bytes(4))
    with pytest.raises(RejectedRequest):
        t7.read(["coil"], 0, 1)


def test_a_profile_s_registers_are_all_there(t7):
    t7.outputs["DAC0"].value = 2.5
    assert t7.read(["holding"], 1000, 2) == bytes.fromhex("4020 0000")
    assert t7.read(["holding"], 55100, 2) == bytes.fromhex("0011 2233")
    assert {id(step) for step in PROFILE.init} <= t7.steps.keys()
