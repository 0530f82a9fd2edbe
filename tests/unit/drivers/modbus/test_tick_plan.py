"""Plans of a tick: which requests they consist of, and where the readings are."""

import numpy as np
import pytest

from hilctl_drivers.modbus import pdu as modbus
from hilctl_drivers.modbus.tick_plan import Tick, TickPlan
from hilctl_drivers.profile import parse_profile

REGISTERS = """\
vendor: nobody
model: registers
source: [this test]
verified: "yes"
link: {kind: tcp}
address_base: 0
exchange: EXCHANGE
turnaround_s: 0.001
max_rate_hz: 1000.0
outputs:
  A: {address: 100, type: float32, unit: V, min: -10.0, max: 10.0}
  B: {address: 102, type: float32, unit: V, min: -10.0, max: 10.0}
  FAR: {address: 200, type: int16, unit: V, min: -10.0, max: 10.0}
  SIX: {address: 104, type: int16, unit: V, min: -10.0, max: 10.0, function: 6}
inputs:
  X: {address: 0, type: float32, unit: V, min: -10.0, max: 10.0}
  Y: {address: 2, type: float32, unit: V, min: -10.0, max: 10.0}
  Z: {address: 4, type: float32, unit: V, min: -10.0, max: 10.0}
  HOLE: {address: 9, type: int16, unit: V, min: -10.0, max: 10.0}
  MON: {address: 6, type: float32, unit: V, min: -10.0, max: 10.0, measures: output}
  MARKED:
    {address: 20, type: int16, unit: V, min: -10.0, max: 10.0,
      validity: {address: 30, type: uint16, mask: 0x1, valid: 0x1}}
watchdog: none
"""


def plan(exchange, outputs, inputs, measures="", aux="", *, combine=True):
    profile = parse_profile(REGISTERS.replace("EXCHANGE", exchange), "registers.yaml")
    named = [[profile.inputs[each] for each in names.split()] for names in (inputs, measures, aux)]
    return TickPlan(profile, [profile.outputs[each] for each in outputs.split()], *named, combine)


@pytest.mark.parametrize(("asked", "functions"), [
    (("76", "A", "X"), [76]),
    (("76", "A B FAR", "X HOLE", "MON", "Z MARKED"), [76]),
    (("23", "A", "X"), [23]),
    (("23", "A B", "X Y"), [23]),
    (("23", "B A", "Z X"), [23]),
    (("23", "A", "X Z"), [23]),  # the profile knows what is in between
    (("23", "A", "X", "MON", "Y Z"), [23]),
    (("23", "A", "X", "", "MARKED"), [23]),  # which would need more requests
    (("23", "A", "MARKED"), [23, 3]),
    (("23", "A B FAR", "X Y"), [3, 16, 16]),  # one write of function 23 can't reach all
    (("23", "A", ""), [16]),  # another device has the input
    (("none", "A B", "X Y"), [3, 16]),
    (("none", "A B SIX", "X Y", "MON"), [3, 16, 6, 3]),
    (("none", "A", "X", "", "HOLE"), [3, 16]),
])  # fmt: skip
def test_requests(asked, functions):
    assert [each.pdu[0] for each in plan(*asked).requests] == functions


@pytest.mark.parametrize(("asked", "covered"), [
    (("76", "A", "X", "", "HOLE MARKED"), [True, True]),
    (("23", "A", "X", "", "Z MARKED"), [True, False]),
    (("23", "A", "X", "", "HOLE"), [False]),  # registers in between are unknown
])  # fmt: skip
def test_auxiliary_channels_that_cost_no_request_are_read(asked, covered):
    found = plan(*asked)
    assert [found.covers(each) for each in found.aux] == covered


class Memory:
    """Registers that answer prepared requests, and the order of their use."""

    def __init__(self):
        self.words = np.zeros(300, ">u2")
        self.used = []

    def prepare(self, pdu):
        start = modbus.data_at(pdu)

        def call(data=b""):
            return self.answer(pdu[:start] + (data or pdu[start:]))

        return call

    def read(self, address, size):
        self.used.append(f"read {address}")
        return self.words[address : address + size].tobytes()

    def write(self, address, data):
        self.used.append(f"write {address}")
        self.words[address : address + len(data) // 2] = np.frombuffer(data, ">u2")

    def answer(self, pdu):
        address, size = (int.from_bytes(pdu[at : at + 2], "big") for at in (1, 3))
        if pdu[0] == modbus.READ_HOLDING:
            return self.read(address, size)
        if pdu[0] == modbus.WRITE_REGISTER:
            self.write(address, pdu[3:])
        if pdu[0] == modbus.WRITE_REGISTERS:
            self.write(address, pdu[6:])
        if pdu[0] == modbus.WRITE_READ:
            self.write(int.from_bytes(pdu[5:7], "big"), pdu[10:])
            return self.read(address, size)
        found, at = b"", 1
        while pdu[0] == modbus.FEEDBACK and at < len(pdu):
            address, size = int.from_bytes(pdu[at + 1 : at + 3], "big"), pdu[at + 3]
            at += modbus.FRAME_HEAD
            if pdu[at - modbus.FRAME_HEAD]:
                self.write(address, pdu[at : at + 2 * size])
                at += 2 * size
            else:
                found += self.read(address, size)
        return found


@pytest.mark.parametrize("combine", [True, False])
@pytest.mark.parametrize("exchange", ["23", "76", "none"])
@pytest.mark.parametrize("outputs", ["A", "B A", "SIX A FAR B"])
@pytest.mark.parametrize("inputs", ["X", "Z MARKED X", "HOLE Y"])
def test_each_register_is_written_and_read_in_its_place(exchange, combine, outputs, inputs):
    found, memory = plan(exchange, outputs, inputs, "MON", "Y Z", combine=combine), Memory()
    sources = [*found.inputs, *found.measures, *(each for each in found.aux if found.covers(each))]
    for k, source in enumerate(sources):
        data = source.format.encode(k + 1.0)
        address = found.profile.wire_address(source)
        memory.words[address : address + source.words] = np.frombuffer(data, ">u2")
    memory.words[30] = 1
    tick = Tick(found, memory.prepare)
    tick.run([each.format.encode(k - 4.0) for k, each in enumerate(found.outputs)])
    last = {id(source): k + 1.0 for k, source in enumerate(sources)}
    by_address = {found.profile.wire_address(source): last[id(source)] for source in sources}
    for source in sources:
        assert tick.reader(source)() == by_address[found.profile.wire_address(source)]
    for k, output in enumerate(found.outputs):
        address = found.profile.wire_address(output)
        held = memory.words[address : address + output.words].tobytes()
        assert output.format.decode(held) == k - 4.0


def test_an_invalid_reading_is_missing():
    found, memory = plan("76", "A", "MARKED"), Memory()
    tick = Tick(found, memory.prepare)
    tick.run([bytes(4)])
    assert np.isnan(tick.reader(found.inputs[0])())


def test_measuring_comes_after_the_write():
    found, memory = plan("76", "A", "X", "MON"), Memory()
    Tick(found, memory.prepare).run([bytes(4)])
    assert memory.used == ["read 0", "write 100", "read 6"]
