"""Time what the loop does to bytes in each exchange, and pymodbus for the same messages.

Run it with ``python -m tests.benchmark.frames``; ``--max-exchange-us`` and ``--max-crc-us`` make it
exit with 1 where building and checking one exchange, or a CRC of 25 bytes, costs more.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from functools import partial

from pymodbus.framer.rtu import FramerRTU
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import ReadWriteMultipleRegistersRequest

from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_pdu,
    rtu_adu,
    tcp_adu,
    write_pdu,
    write_read_pdu,
)
from hilctl_drivers.modbus.registers import RegisterFormat
from hilctl_drivers.modbus.transactions import RtuTransaction, TcpTransaction
from hilctl_drivers.text.lines import LineFormat, parse_number
from hilctl_drivers.wire.crc import CRCS
from hilctl_drivers.wire.framing import Framing, binary_framing

CALLS = 20_000
ROUNDS = 9
FLOAT = RegisterFormat("float32")
ZERO = bytes(4)
PDUS = {
    "write 16": write_pdu(0, ZERO),
    "read 4": read_pdu(4, 0, 2),
    "write and read 23": write_read_pdu(0, 2, 0x800, ZERO),
    "feedback 76": feedback_pdu(1000, ZERO, 0, 2),
}
REPLIES = {16: PDUS["write 16"][1:5], 4: b"\4" + ZERO, 23: b"\4" + ZERO, 76: ZERO}

Step = Callable[[float], object]


def best_us(step: Step) -> float:
    """Return the least time of one call in microseconds, with another value in each call."""
    values = [k * 1e-3 for k in range(CALLS)]
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter_ns()
        for value in values:
            step(value)
        times.append(time.perf_counter_ns() - start)
    return min(times) / CALLS / 1e3


def tcp_exchange(pdu: bytes) -> Step:
    """Return one tick over TCP: value to request, reply to value."""
    transaction = TcpTransaction(1, pdu)
    data = b"" if pdu[0] == 4 else ZERO
    reply = bytearray(tcp_adu(0, 1, pdu[:1] + REPLIES[pdu[0]]))

    def step(value: float) -> float:
        request = transaction.request(FLOAT.encode(value) if data else data)
        reply[:2] = request[:2]
        read = transaction.reply(reply)
        return FLOAT.decode(read) if read else 0.0

    return step


def rtu_exchange(pdu: bytes) -> Step:
    """Return one tick over RTU: value to request, reply to value."""
    transaction = RtuTransaction(1, pdu)
    data = b"" if pdu[0] == 4 else ZERO
    reply = rtu_adu(1, pdu[:1] + REPLIES[pdu[0]])

    def step(value: float) -> float:
        transaction.request(FLOAT.encode(value) if data else data)
        read = transaction.reply(reply)
        return FLOAT.decode(read) if read else 0.0

    return step


def pymodbus_exchange(framer: FramerSocket | FramerRTU, reply: bytes) -> Step:
    """Return pymodbus's framing of function 23, without its client and without conversions."""
    numbers = itertools.cycle(range(1, 65536))

    def step(_value: float) -> object:
        request = ReadWriteMultipleRegistersRequest(
            read_address=0, read_count=2, write_address=0x800, write_registers=[0, 0],
            dev_id=1, transaction_id=next(numbers),
        )  # fmt: skip
        framer.buildFrame(request)
        return framer.handleFrame(reply, 1, 0)

    return step


def steps() -> dict[str, Step]:
    """Return everything to be timed, by name."""
    frames = {
        "COBS, crc16_modbus": binary_framing("cobs", "crc16_modbus"),
        "COBS, crc32": binary_framing("cobs", "crc32"),
        "length, crc16_ccitt_false": binary_framing("length", "crc16_ccitt_false"),
    }
    line = LineFormat(checksum="dcon")
    answer = PDUS["write and read 23"][:1] + REPLIES[23]
    return {
        **{f"CRC of 25 bytes: {name}": partial(crc_of, name) for name in CRCS if name != "none"},
        **{f"exchange: TCP {name}": tcp_exchange(pdu) for name, pdu in PDUS.items()},
        **{f"exchange: RTU {name}": rtu_exchange(pdu) for name, pdu in PDUS.items()},
        **{f"frame of 8 bytes and back: {name}": there_and_back(f) for name, f in frames.items()},
        "DCON line and back": lambda value: parse_number(
            line.decode(line.encode(f"{value:+07.3f}"))
        ),
        "pymodbus framing: TCP write and read 23": pymodbus_exchange(
            FramerSocket(DecodePDU(False)), tcp_adu(1, 1, answer)
        ),
        "pymodbus framing: RTU write and read 23": pymodbus_exchange(
            FramerRTU(DecodePDU(False)), rtu_adu(1, answer)
        ),
    }  # fmt: skip


def crc_of(name: str, value: float) -> int:
    """Return a CRC of 25 bytes that differ from call to call."""
    return CRCS[name].compute(FLOAT.encode(value) * 6 + b"\1")


def there_and_back(framing: Framing) -> Step:
    """Return one payload of 8 bytes framed and read again."""
    return lambda value: framing.decode(framing.encode(FLOAT.encode(value) * 2))


def main() -> int:
    """Time all steps, print them, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-exchange-us", type=float, default=float("inf"))
    parser.add_argument("--max-crc-us", type=float, default=float("inf"))
    limits = parser.parse_args()
    slow = False
    for name, step in steps().items():
        step(0.5)
        cost_us = best_us(step)
        limit_us = {"exchange": limits.max_exchange_us, "CRC of 25 bytes": limits.max_crc_us}.get(
            name.partition(":")[0], float("inf")
        )
        slow |= cost_us > limit_us
        print(f"{cost_us:8.2f} us  {name}{'  above the limit' if cost_us > limit_us else ''}")
    return int(slow)


if __name__ == "__main__":
    sys.exit(main())
