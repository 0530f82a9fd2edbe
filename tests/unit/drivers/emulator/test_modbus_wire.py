"""Requests as pymodbus takes them apart, replies as our framing takes them apart."""

import pytest

from hilctl_drivers.emulator.modbus_wire import ModbusWire
from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_frame,
    read_pdu,
    reply_data,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_pdu,
    write_frame,
    write_pdu,
    write_read_pdu,
)
from hilctl_drivers.modbus.register_map import RegisterFormat
from hilctl_drivers.transport.links import RefusedError
from tests.unit.drivers.emulator.conftest import emulated_modbus

FLOAT32 = RegisterFormat("float32")


@pytest.fixture
def t7():
    """An emulated T7 behind Modbus TCP."""
    return ModbusWire("tcp", {1: emulated_modbus("labjack_t7", "DAC0", "AIN0")})


def requests(wire, received):
    return list(wire.requests(bytearray(received)))


def ask(wire, pdu, now_ns=0):
    """Send a request over TCP framing and return the checked reply's data."""
    (request,) = requests(wire, tcp_adu(7, 1, pdu))
    return reply_data(pdu, tcp_pdu(wire.answer(request, now_ns).data, 7, 1))


@pytest.mark.parametrize(("pdu", "code"), [
    (read_pdu(3, 12345, 1), 2),
    (read_pdu(3, 0, 9), 2),
    (write_pdu(0, FLOAT32.encode(1.0)), 2),
    (write_pdu(1000, b"\x00\x00"), 2),
    (write_pdu(1000, FLOAT32.encode(5.1)), 3),
    (write_pdu(1000, FLOAT32.encode(-0.1)), 3),
    (write_pdu(1000, b"\x7f\xc0\x00\x00"), 3),
    (write_pdu(1000, FLOAT32.encode(1.0) + FLOAT32.encode(9.0)), 3),
    (write_read_pdu(0, 2, 1000, FLOAT32.encode(1.0)), 1),
])  # fmt: skip
def test_refusals_change_nothing(t7, pdu, code):
    ask(t7, write_pdu(1000, FLOAT32.encode(2.0)))
    with pytest.raises(RefusedError) as refusal:
        ask(t7, pdu)
    assert refusal.value.code == code
    assert FLOAT32.decode(ask(t7, read_pdu(3, 1000, 2))) == 2.0


@pytest.mark.parametrize(("profile", "pdu", "written"), [
    ("labjack_t7", write_pdu(1000, bytes(4)), {"DAC0"}),
    ("labjack_t7", write_pdu(1000, bytes(8)), {"DAC0", "DAC1"}),
    ("labjack_t7", read_pdu(3, 1000, 2), set()),
    ("labjack_t7", write_pdu(61600, bytes(4)), set()),
    ("labjack_t7", feedback_pdu(read_frame(1000, 2), write_frame(1002, bytes(4))), {"DAC1"}),
    ("labjack_t7", b"\x10\x03", set()),
    ("wago_750", b"\x06\x00\x01\x00\x00", {"AO1"}),
    ("wago_750", write_read_pdu(0, 2, 1, bytes(2)), {"AO1"}),
    ("wago_750", b"\x05\x00\x01\xff\x00", set()),
])  # fmt: skip
def test_outputs_that_a_request_writes(profile, pdu, written):
    output, source = ("DAC0", "AIN0") if profile == "labjack_t7" else ("AO0", "AI0")
    wire = ModbusWire("tcp", {1: emulated_modbus(profile, output, source)})
    (request,) = requests(wire, tcp_adu(7, 1, pdu))
    assert wire.written(request) - {""} == written


def test_requests_in_one_segment_are_all_answered(t7):
    pdu = read_pdu(3, 1000, 2)
    both = tcp_adu(1, 1, pdu) + tcp_adu(2, 1, pdu)
    received = bytearray(both + both[:5])
    replies = [t7.answer(request, 0).data for request in t7.requests(received)]
    assert [int.from_bytes(reply[:2], "big") for reply in replies] == [1, 2]
    assert received == both[:5]


def test_rtu_ignores_others_and_rubbish():
    wire = ModbusWire("rtu", {1: emulated_modbus("wago_750", "AO0", "AI0")})
    pdu = read_pdu(3, 0x200, 1)
    good = rtu_adu(1, pdu)
    (request,) = requests(wire, good)
    assert len(reply_data(pdu, rtu_pdu(wire.answer(request, 0).data, 1))) == 2
    assert requests(wire, rtu_adu(2, pdu)) == []
    assert requests(wire, good[:-1] + bytes([good[-1] ^ 1])) == []


def test_gateway_says_that_a_unit_is_not_there(t7):
    """Over TCP a unit that nobody has is exception 11; one device alone takes any unit."""
    device = emulated_modbus("labjack_t7", "DAC0", "AIN0")
    pdu = read_pdu(3, 1000, 2)
    wire = ModbusWire("tcp", {1: device, 2: device})
    (request,) = requests(wire, tcp_adu(7, 3, pdu))
    with pytest.raises(RefusedError) as refusal:
        reply_data(pdu, tcp_pdu(wire.answer(request, 0).data, 7, 3))
    assert refusal.value.code == 11
    assert len(reply_data(pdu, tcp_pdu(t7.answer(request, 0).data, 7, 3))) == 4
