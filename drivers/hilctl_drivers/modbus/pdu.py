"""Modbus messages: request PDUs, checks of reply PDUs, and their TCP and RTU envelopes.

Sources: "MODBUS Application Protocol Specification" V1.1b3 (sections 6.1 to 6.17 for the functions,
7 for exceptions), "MODBUS Messaging on TCP/IP Implementation Guide" V1.0b (3.1.3), "MODBUS over
Serial Line" V1.02 (2.5.1, CRC in 6.2.2), and for function 76 LabJack's "Protocol Details [Direct
Modbus TCP]". Addresses are PDU addresses: counted from 0. Register data have 2 bytes per register.

Builders check nothing: a profile is validated, so its addresses, sizes and units are possible.
"""

import struct

from hilctl_drivers.transport.crc import Bytes, crc16_modbus
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    IncompleteError,
    MismatchError,
    RefusedError,
)

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT = 1, 2, 3, 4
WRITE_COIL, WRITE_REGISTER, WRITE_REGISTERS, WRITE_READ = 5, 6, 16, 23
FEEDBACK = 76
PLAIN_WRITES = frozenset({WRITE_COIL, WRITE_REGISTER, WRITE_REGISTERS})
READ_MAX = 125
"""Registers that one request may read."""
PDU_MAX = 253
RTU_SHORTEST = 5
"""Bytes of the shortest RTU reply."""
TCP_HEAD = 7
"""Bytes of the MBAP header, unit included."""
FRAME_HEAD = 4
"""Bytes of a feedback frame before its data."""
_frame_head = struct.Struct(">BHB").pack

EXCEPTIONS = {
    1: "illegal function", 2: "illegal data address", 3: "illegal data value",
    4: "device failure", 5: "acknowledged, still working", 6: "device busy",
    8: "memory parity error", 10: "gateway path unavailable",
    11: "gateway target does not answer: check unit_id",
}  # fmt: skip


def read_pdu(function: int, address: int, count: int) -> bytes:
    """Return a request to read bits (functions 1, 2) or registers (3, 4)."""
    return struct.pack(">BHH", function, address, count)


def write_pdu(address: int, data: bytes) -> bytes:
    """Return a request to write registers (function 16)."""
    return struct.pack(">BHHB", WRITE_REGISTERS, address, len(data) // 2, len(data)) + data


def write_single_pdu(address: int, data: bytes) -> bytes:
    """Return a request to write one register (function 6)."""
    return struct.pack(">BH", WRITE_REGISTER, address) + data


def coil_pdu(address: int, on: bool) -> bytes:
    """Return a request to switch one coil (function 5)."""
    return struct.pack(">BHH", WRITE_COIL, address, 0xFF00 if on else 0)


def write_read_pdu(read_address: int, read_count: int, write_address: int, data: bytes) -> bytes:
    """Return a request to write registers, then read registers (function 23)."""
    head = (WRITE_READ, read_address, read_count, write_address, len(data) // 2, len(data))
    return struct.pack(">BHHHHB", *head) + data


def read_frame(address: int, words: int) -> bytes:
    """Return the frame that reads registers from ``address`` on: ``00 address16 words8``."""
    return _frame_head(0, address, words)


def write_frame(address: int, data: bytes) -> bytes:
    """Return the frame that writes registers: ``01 address16 words8 data``.

    A buffer register takes all.
    """
    return _frame_head(1, address, len(data) // 2) + data


def feedback_pdu(*frames: bytes) -> bytes:
    """Return a LabJack Modbus Feedback request (76), which executes frames in their order.

    A reply has the words of each read.
    """
    return bytes((FEEDBACK,)) + b"".join(frames)


def data_at(pdu: bytes) -> int:
    """Return where the data to write begin in a request PDU; its length if it only reads."""
    if pdu[0] != FEEDBACK:
        return {WRITE_REGISTER: 3, WRITE_REGISTERS: 6, WRITE_READ: 10}.get(pdu[0], len(pdu))
    at = 1
    while at < len(pdu) and not pdu[at]:
        at += FRAME_HEAD
    return min(at + FRAME_HEAD, len(pdu))


def reply_layout(pdu: bytes) -> tuple[bytes, int]:
    """Return the first bytes of a good reply to a request PDU, and the number of data bytes."""
    function = pdu[0]
    if function in {READ_COILS, READ_DISCRETE}:
        size = (int.from_bytes(pdu[3:5], "big") + 7) // 8
    elif function in {READ_HOLDING, READ_INPUT, WRITE_READ}:
        size = 2 * int.from_bytes(pdu[3:5], "big")
    elif function in PLAIN_WRITES:
        return pdu[:5], 0
    else:
        return pdu[:1], sum(feedback_sizes(pdu))
    return bytes((function, size)), size


def feedback_sizes(pdu: bytes) -> list[int]:
    """Return the number of bytes that each read frame of a Modbus Feedback request reads."""
    sizes, at = [], 1
    while at < len(pdu):
        size = 2 * pdu[at + 3]
        if pdu[at]:
            at += size
        else:
            sizes.append(size)
        at += FRAME_HEAD
    return sizes


def reply_size(pdu: bytes) -> int:
    """Return the number of bytes of a good reply PDU to a request PDU."""
    head, size = reply_layout(pdu)
    return len(head) + size


def reply_data(request_pdu: bytes, reply_pdu: bytes) -> bytes:
    """Check a reply against its request and return the register bytes or packed bits that it reads.

    Raises:
        RefusedError: An exception reply; ``code`` is the exception code.
        MismatchError: Another function, byte count, length, or echoed address, count or value.
    """
    head, size = reply_layout(request_pdu)
    function = request_pdu[0]
    if len(reply_pdu) == 2 and reply_pdu[0] == function | 0x80:
        code = reply_pdu[1]
        name = EXCEPTIONS.get(code, "unknown")
        said = f"function {function} refused with exception {code} ({name})"
        raise RefusedError(said + _place(request_pdu), code)
    if not reply_pdu or reply_pdu[0] != function:
        got = reply_pdu[0] if reply_pdu else "nothing"
        raise MismatchError(f"asked with function {function}, answered with {got}")
    if len(reply_pdu) != len(head) + size:
        raise MismatchError(f"reply must have {len(head) + size} bytes, got {len(reply_pdu)}")
    if reply_pdu[: len(head)] != head:
        got_head = reply_pdu[: len(head)].hex(" ")
        raise MismatchError(f"reply must begin with {head.hex(' ')}, got {got_head}")
    return bytes(reply_pdu[len(head) :])


def _place(request_pdu: bytes) -> str:
    """Return the addresses of a request, as in a message; empty for function 76."""
    if request_pdu[0] == FEEDBACK:
        return ""
    at = f" at address {int.from_bytes(request_pdu[1:3], 'big')}"
    if request_pdu[0] == WRITE_READ:
        at += f" (read) and {int.from_bytes(request_pdu[5:7], 'big')} (write)"
    return at


def tcp_adu(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return ``pdu`` with its MBAP header, for a unit from 0 to 255."""
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def tcp_pdu(adu: Bytes, transaction: int, unit: int) -> bytes:
    """Check the MBAP header of exactly one message and return its PDU.

    Raises:
        IncompleteError: More bytes belong to it.
        CorruptError: Not Modbus, an impossible length, or bytes after its end.
        MismatchError: Another transaction or unit.
    """
    if len(adu) < TCP_HEAD:
        raise IncompleteError(f"{len(adu)} of at least {TCP_HEAD + 1} bytes")
    got_transaction, protocol, length, got_unit = struct.unpack_from(">HHHB", adu)
    if protocol or not 2 <= length <= PDU_MAX + 1:
        raise CorruptError(f"not a Modbus TCP header: {bytes(adu[:TCP_HEAD]).hex(' ')}")
    if len(adu) < length + 6:
        raise IncompleteError(f"{len(adu)} of {length + 6} bytes")
    if len(adu) > length + 6:
        raise CorruptError(f"{len(adu) - length - 6} bytes after the end of the reply")
    if got_transaction != transaction:
        raise MismatchError(f"transaction must be {transaction}, got {got_transaction}")
    if got_unit != unit:
        raise MismatchError(f"unit must be {unit}, got {got_unit}")
    return bytes(adu[TCP_HEAD:])


def rtu_adu(unit: int, pdu: bytes) -> bytes:
    """Return ``pdu`` with CRC; raise BadRequestError for unit 0, broadcast, which has no answer."""
    if not unit:
        raise BadRequestError("unit must be 1 to 255, got 0")
    frame = bytes((unit,)) + pdu
    return frame + crc16_modbus(frame).to_bytes(2, "little")


def rtu_pdu(adu: Bytes, unit: int) -> bytes:
    """Check unit and CRC of exactly one message and return its PDU.

    Raises:
        IncompleteError: Fewer than 5 bytes, which no reply has.
        CorruptError: The CRC is wrong.
        MismatchError: Another unit.
    """
    if len(adu) < RTU_SHORTEST:
        raise IncompleteError(f"{len(adu)} of at least {RTU_SHORTEST} bytes")
    if crc16_modbus(adu):
        raise CorruptError(f"CRC of {len(adu)} bytes is wrong: {bytes(adu[:16]).hex(' ')}")
    if adu[0] != unit:
        raise MismatchError(f"unit must be {unit}, got {adu[0]}")
    return bytes(adu[1:-2])
