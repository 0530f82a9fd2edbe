"""Registers of an emulated device: what can be read where, and who may write."""

import pytest

from hilctl_drivers.emulator.registers import RegisterBank, RegisterMap, RejectedRequest, Words
from hilctl_drivers.modbus.register_map import Register
from hilctl_drivers.profile import load_profile

FLOAT = Register(address=10, type="float32", order="CDAB")
BIT = Register(area="coil", address=3, type="bit")


def test_words_stand_for_a_value_in_the_register_s_own_order():
    words = Words(FLOAT)
    words.value = 1.5
    assert words.words == [0x0000, 0x3FC0]
    assert words.value == 1.5
    bit = Words(BIT)
    bit.value = 7.0
    assert (bit.words, bit.value) == ([1], 1.0)


@pytest.fixture
def bank():
    made = RegisterBank()
    made.place(Words(FLOAT), "holding", 10)
    made.place(Words(FLOAT), "input", 20, write=False)
    return made


def test_all_of_a_value_is_written_or_nothing(bank):
    ((target, words),) = bank.targets("holding", 10, [1, 2])
    assert words == [1, 2]
    target.words[:] = words
    assert bank.read(["holding"], 10, 2) == bank.written("holding", 10, 2) == [1, 2]
    for address, values in ((10, [1]), (11, [1]), (10, [1, 2, 3])):
        with pytest.raises(RejectedRequest):
            bank.targets("holding", address, values)


def test_what_is_read_only_is_not_there_for_writes(bank):
    assert bank.read(["holding", "input"], 20, 2) == [0, 0]
    with pytest.raises(RejectedRequest):
        bank.targets("input", 20, [1, 2])
    with pytest.raises(RejectedRequest):
        bank.read(["holding"], 20, 1)


def test_one_place_holds_one_value():
    bank = RegisterBank()
    first = bank.place(Words(FLOAT), "holding", 10)
    assert bank.place(Words(FLOAT), "holding", 10) is first


def test_a_profile_s_registers_are_all_there():
    profile = load_profile("labjack_t7")
    found = RegisterMap(profile)
    found.outputs["DAC0"].value = 2.5
    assert found.memory.read(["holding"], 1000, 2) == [0x4020, 0]
    assert found.memory.read(["holding"], 55100, 2) == [0x0011, 0x2233]
    assert {id(step) for step in profile.init} <= found.steps.keys()
    with pytest.raises(RejectedRequest):
        found.memory.targets("holding", 0, [0, 0])
