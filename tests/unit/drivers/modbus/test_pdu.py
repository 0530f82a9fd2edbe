"""Modbus messages: the specification's own examples, its limits, and replies to something else.

"Specification" is "MODBUS Application Protocol Specification" V1.1b3.
"""

import pytest
from pymodbus.framer.rtu import FramerRTU
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.bit_message import WriteSingleCoilRequest
from pymodbus.pdu.exceptionresponse import ExceptionResponse
from pymodbus.pdu.register_message import (
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from hilctl_drivers.modbus.pdu import (
    coil_pdu,
    feedback_pdu,
    read_frame,
    read_pdu,
    reply_data,
    reply_size,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_pdu,
    write_frame,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    IncompleteError,
    MismatchError,
    RefusedError,
)

H = bytes.fromhex
FOUR = H("01020304")


def read_and_write(target, data, source, words):
    return feedback_pdu(read_frame(source, words), write_frame(target, data))


EXAMPLES = [
    pytest.param(read_pdu(1, 0x13, 19), "01 0013 0013", "01 03 CD6B05", "CD6B05", id="6.1"),
    pytest.param(read_pdu(2, 0xC4, 22), "02 00C4 0016", "02 03 ACDB35", "ACDB35", id="6.2"),
    pytest.param(
        read_pdu(3, 0x6B, 3), "03 006B 0003", "03 06 022B 0000 0064", "022B00000064", id="6.3"),
    pytest.param(read_pdu(4, 8, 1), "04 0008 0001", "04 02 000A", "000A", id="6.4"),
    pytest.param(coil_pdu(0xAC, True), "05 00AC FF00", "05 00AC FF00", "", id="6.5"),
    pytest.param(write_single_pdu(1, H("0003")), "06 0001 0003", "06 0001 0003", "", id="6.6"),
    pytest.param(
        write_pdu(1, H("000A0102")), "10 0001 0002 04 000A 0102", "10 0001 0002", "", id="6.12"),
    pytest.param(write_read_pdu(3, 6, 14, H("00FF00FF00FF")),
        "17 0003 0006 000E 0003 06 00FF 00FF 00FF", "17 0C 00FE 0ACD 0001 0003 000D 00FF",
        "00FE0ACD00010003000D00FF", id="6.17"),
    # Beijer GN-9289 manual 8.2.10.
    pytest.param(write_read_pdu(0x800, 2, 0x800, H("11223344")),
        "17 0800 0002 0800 0002 04 1122 3344", "17 04 1122 3344", "11223344", id="GN-9289"),
    # LabJack's frames: write "01 addr16 nregs data", read "00 addr16 nregs"; the reply is data.
    pytest.param(read_and_write(1000, H("40200000"), 0, 2), "4C 00 0000 02 01 03E8 02 40200000",
        "4C 3F800000", "3F800000", id="LabJack MBFB"),
    pytest.param(read_and_write(3, H("12345678"), 1, 1), "4C 00 0001 01 01 0003 02 12345678",
        "4C 9ABC", "9ABC", id="LabJack MBFB, other sizes"),
]  # fmt: skip


@pytest.mark.parametrize(("pdu", "request_hex", "reply_hex", "data_hex"), EXAMPLES)
def test_published_examples(pdu, request_hex, reply_hex, data_hex):
    assert pdu == H(request_hex)
    assert reply_size(pdu) == len(H(reply_hex))
    assert reply_data(pdu, H(reply_hex)) == H(data_hex)


@pytest.mark.parametrize(("pdu", "wire"), [
    (write_single_pdu(0, (1000).to_bytes(2, "big")), "01 06 00 00 03 E8 89 74"),
    (read_pdu(3, 0x6B, 3), "01 03 00 6B 00 03 74 17"),
    (H("03 06 02 2B 00 00 00 64"), "01 03 06 02 2B 00 00 00 64 05 7A"),
    (read_pdu(4, 0, 8), "01 04 00 00 00 08 F1 CC"),
])  # fmt: skip
def test_published_rtu_frames(pdu, wire):
    """Waveshare AO 8CH (1000 to channel 1, reading 8), and a valve manual's read of 3 registers."""
    assert rtu_adu(1, pdu) == H(wire)
    assert rtu_pdu(H(wire), 1) == pdu


def test_tcp_frame_byte_by_byte():
    """Implementation Guide 3.1.3: transaction, protocol 0, length from the unit on, unit."""
    assert tcp_adu(0x1501, 0xFF, read_pdu(3, 4, 1)) == H("1501 0000 0006 FF 03 0004 0001")
    assert tcp_pdu(H("1501 0000 0005 FF 03 02 0005"), 0x1501, 0xFF) == H("03 02 0005")


# Each request here and the same from pymodbus; tests/property/test_frames.py has the others.
SAME = [
    (read_pdu(4, 65534, 2), ReadInputRegistersRequest(address=65534, count=2)),
    (coil_pdu(7, True), WriteSingleCoilRequest(address=7, bits=[True])),
    (coil_pdu(7, False), WriteSingleCoilRequest(address=7, bits=[False])),
    (write_single_pdu(9, H("8001")), WriteSingleRegisterRequest(address=9, registers=[0x8001])),
]


@pytest.mark.parametrize(("pdu", "theirs"), SAME)
def test_requests_are_those_of_pymodbus(pdu, theirs):
    theirs.dev_id, theirs.transaction_id = 17, 513
    assert tcp_adu(513, 17, pdu) == FramerSocket(DecodePDU(True)).buildFrame(theirs)
    assert rtu_adu(17, pdu) == FramerRTU(DecodePDU(True)).buildFrame(theirs)
    for framer, adu, transaction in (
        (FramerSocket, tcp_adu(513, 17, pdu), 513),
        (FramerRTU, rtu_adu(17, pdu), 0),
    ):
        used, got = framer(DecodePDU(True)).handleFrame(adu, 17, transaction)
        assert used == len(adu)
        assert type(got) is type(theirs)
        assert got.encode() == theirs.encode()


@pytest.mark.parametrize(
    ("pdu", "theirs", "data"),
    [
        (SAME[0][0], ReadInputRegistersResponse(registers=[1, 0xFFFF]), H("0001FFFF")),
        (SAME[3][0], WriteSingleRegisterResponse(address=9, registers=[0x8001]), b""),
    ],
)  # fmt: skip
def test_replies_of_pymodbus_are_read(pdu, theirs, data):
    theirs.dev_id, theirs.transaction_id = 17, 513
    tcp = FramerSocket(DecodePDU(False)).buildFrame(theirs)
    rtu = FramerRTU(DecodePDU(False)).buildFrame(theirs)
    assert reply_data(pdu, tcp_pdu(tcp, 513, 17)) == data
    assert reply_data(pdu, rtu_pdu(rtu, 17)) == data
    assert len(rtu) == reply_size(pdu) + 3


@pytest.mark.parametrize(
    ("code", "name"), [(1, "illegal function"), (2, "address"), (77, "unknown")]
)
def test_exceptions_are_refusals_with_their_code(code, name):
    """Specification section 7; pymodbus builds the reply."""
    theirs = ExceptionResponse(23, code)
    theirs.dev_id, theirs.transaction_id = 1, 5
    adu = FramerSocket(DecodePDU(False)).buildFrame(theirs)
    with pytest.raises(
        RefusedError, match=f"function 23 .*exception {code} .*{name}.* 0 .* 2048"
    ) as caught:
        reply_data(write_read_pdu(0, 2, 0x800, FOUR), tcp_pdu(adu, 5, 1))
    assert caught.value.code == code


@pytest.mark.parametrize(("request_pdu", "place"), [
    (read_pdu(3, 200, 1), "address 200"), (write_single_pdu(3, H("0102")), "address 3"),
])  # fmt: skip
def test_exception_names_the_address(request_pdu, place):
    with pytest.raises(RefusedError, match=rf"{place}$"):
        reply_data(request_pdu, bytes((request_pdu[0] | 0x80, 2)))


def test_a_broadcast_is_not_built():
    with pytest.raises(BadRequestError):
        rtu_adu(0, FOUR)


@pytest.mark.parametrize(("pdu", "reply"), [
    (read_pdu(3, 0, 2), "04 04 00000000"),
    (read_pdu(3, 0, 2), "03 02 0000"),
    (read_pdu(3, 0, 2), "03 04 000000"),
    (read_pdu(3, 0, 2), "03 04 0000000000"),
    (read_pdu(3, 0, 2), "03 03 00000000"),
    (read_pdu(3, 0, 2), "84 02"),
    (read_pdu(3, 0, 2), "83"),
    (read_pdu(3, 0, 2), "83 02 00"),
    (read_pdu(3, 0, 2), ""),
    (read_pdu(1, 0, 9), "01 01 00"),
    (write_pdu(1, FOUR), "10 0002 0002"),
    (write_pdu(1, FOUR), "10 0001 0001"),
    (write_pdu(1, FOUR), "10 0001"),
    (write_single_pdu(1, b"ab"), "06 0001 6163"),
    (write_single_pdu(1, b"ab"), "06 0002 6162"),
    (coil_pdu(1, True), "05 0001 0000"),
    (write_read_pdu(0, 2, 9, FOUR), "17 02 0000"),
    (write_read_pdu(0, 2, 9, FOUR), "03 04 00000000"),
    (read_and_write(0, FOUR, 0, 2), "4C 0000"),
    (read_and_write(0, FOUR, 0, 2), "4C 0000000000"),
])  # fmt: skip
def test_answers_to_something_else_are_mismatches(pdu, reply):
    with pytest.raises(MismatchError):
        reply_data(pdu, H(reply))


GOOD = H("0102 0000 0005 11 03 02 0005")


@pytest.mark.parametrize(("adu", "error", "rule"), [
    (H("0103 0000 0005 11 03 02 0005"), MismatchError, "transaction must be 258, got 259"),
    (H("0102 0000 0005 12 03 02 0005"), MismatchError, "unit must be 17, got 18"),
    (H("0102 0001 0005 11 03 02 0005"), CorruptError, "not a Modbus TCP header"),
    (H("0102 0000 0001 11 03 02 0005"), CorruptError, "not a Modbus TCP header"),
    (H("0102 0000 00FF 11 03 02 0005"), CorruptError, "not a Modbus TCP header"),
    (H("0102 0000 0006 11 03 02 0005"), IncompleteError, "11 of 12"),
    (H("0102 0000 0004 11 03 02 0005"), CorruptError, "1 bytes"),
    (GOOD * 2, CorruptError, "11 bytes"),
])  # fmt: skip
def test_tcp_headers_of_something_else(adu, error, rule):
    with pytest.raises(error, match=rule):
        tcp_pdu(adu, 258, 17)


def test_beginnings_of_frames_are_incomplete():
    assert tcp_pdu(GOOD, 258, 17) == H("03 02 0005")
    for cut in range(len(GOOD)):
        with pytest.raises(IncompleteError):
            tcp_pdu(GOOD[:cut], 258, 17)
    frame = rtu_adu(1, read_pdu(3, 0, 1))
    for cut in range(5):
        with pytest.raises(IncompleteError):
            rtu_pdu(frame[:cut], 1)


def test_rtu_checks_crc_before_unit():
    frame = rtu_adu(2, H("03 02 0005"))
    with pytest.raises(MismatchError, match=r"unit .*1, got 2"):
        rtu_pdu(frame, 1)
    with pytest.raises(CorruptError, match="CRC"):
        rtu_pdu(b"\x01" + frame[1:], 1)
