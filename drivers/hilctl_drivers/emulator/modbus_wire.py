"""Modbus side of an emulated device: framing and messages of pymodbus.

The only module that imports pymodbus. The driver has its own framing, so tests detect a mistake in
either. The server of pymodbus is not used: it loses the second of two requests in one segment, and
cannot inject faults into replies.
"""

import struct
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.wire import EmulatedReply, EmulatedWire, RejectedRequest

_CORRUPT_AT = 3  # the protocol id (TCP), data (RTU)

_AREAS: dict[int, tuple[str, ...]] = {
    1: ("coil",),
    2: ("discrete",),
    3: ("holding",),
    4: ("input",),
    23: ("holding", "input"),
    76: ("holding", "input"),
}


def _feedback_frames(data: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield whether a frame writes, its address, number of registers, and data."""
    while data:
        write, address, count = struct.unpack_from(">BHB", data)
        size = 4 + 2 * count * write
        yield write, address, count, data[4:size]
        data = data[size:]


def _writes(pdu: bytes) -> Iterator[tuple[str, int, int]]:
    """Yield area, address and number of the registers that a message writes."""
    function = pdu[0]
    if function in {5, 6}:
        yield "coil" if function == 5 else "holding", int.from_bytes(pdu[1:3], "big"), 1
    elif function in {15, 16, 23}:
        address, count = struct.unpack_from(">HH", pdu, 5 if function == 23 else 1)
        yield "coil" if function == 15 else "holding", address, count
    elif function == 76:
        for write, address, count, _ in _feedback_frames(pdu[1:]):
            if write:
                yield "holding", address, count


class FeedbackPdu(ModbusPDU):
    """LabJack's Modbus Feedback, function 76: read and write frames in one message."""

    function_code = 76
    rtu_byte_count_pos = 2  # it is not spoken over RTU, but pymodbus asks

    def __init__(self, data: bytes = b"") -> None:
        super().__init__()
        self.data = data

    def encode(self) -> bytes:
        """Return the data."""
        return self.data

    def decode(self, data: bytes) -> None:
        """Keep the data."""
        self.data = data

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        """Execute frame after frame, as LabJack's protocol page describes them."""
        reply = b""
        try:
            for write, address, count, data in _feedback_frames(self.data):
                if write > 1 or len(data) < 2 * count * write:
                    return ExceptionResponse(76, ExcCodes.ILLEGAL_VALUE)
                if write:
                    context.device.write("holding", address, data)
                else:
                    reply += context.device.read(_AREAS[76], address, count)
        except RejectedRequest as rejected:
            return ExceptionResponse(76, ExcCodes(rejected.code))
        return FeedbackPdu(reply)


class _Context:
    """A device's registers for pymodbus's messages."""

    def __init__(self, device: EmulatedModbus) -> None:
        self.device = device

    async def async_getValues(  # noqa: N802  pymodbus calls it by this name
        self, device_id: int, function: int, address: int, count: int
    ) -> list[int] | ExcCodes:
        try:
            if function in {5, 6}:  # read back for the echo
                area = "coil" if function == 5 else "holding"
                data = self.device.memory.written(area, address, count)
            else:
                data = self.device.read(_AREAS[function], address, count)
        except RejectedRequest as rejected:
            return ExcCodes(rejected.code)
        return list(struct.unpack(f">{count}H", data))

    async def async_setValues(  # noqa: N802  pymodbus calls it by this name
        self, device_id: int, function: int, address: int, values: Sequence[int]
    ) -> ExcCodes | None:
        area = "coil" if function in {5, 15} else "holding"
        try:
            self.device.write(area, address, struct.pack(f">{len(values)}H", *values))
        except RejectedRequest as rejected:
            return ExcCodes(rejected.code)
        return None


def _finish(call: Coroutine[Any, Any, ModbusPDU]) -> ModbusPDU:
    """Return the result of a coroutine that never waits."""
    try:
        call.send(None)
    except StopIteration as end:
        result: ModbusPDU = end.value
        return result
    raise AssertionError("a register access waited")


class ModbusWire(EmulatedWire):
    """Devices behind Modbus TCP or RTU: requests from bytes, and replies to bytes.

    A single device on a TCP connection answers to any unit id, as real devices do; on a line, or
    with others behind a gateway, it answers only to its own.
    """

    def __init__(self, kind: Literal["tcp", "rtu"], devices: Mapping[int, EmulatedModbus]) -> None:
        self._kind = kind
        self._units = devices
        self.devices = tuple(devices.values())
        self._any_unit = kind == "tcp" and len(devices) == 1
        self._decoder = DecodePDU(is_server=True)
        self._decoder.register(FeedbackPdu)
        self._framer = (FramerSocket if kind == "tcp" else FramerRTU)(self._decoder)

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield complete requests; remove these and requests for other devices."""
        while received:
            used, unit, transaction, pdu = self._framer.decode(bytes(received))
            if not used:
                return
            del received[:used]
            if pdu and (self._kind == "tcp" or unit in self._units):
                yield struct.pack(">HB", transaction, unit) + pdu

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply:
        """Execute a request."""
        return self._answered(self._reply(request, now_ns), request)

    def _device(self, request: bytes) -> EmulatedModbus | None:
        return self._units.get(min(self._units) if self._any_unit else request[2])

    def _reply(self, request: bytes, now_ns: int) -> ModbusPDU:
        unit, function = request[2], request[3]
        device = self._device(request)
        if device is None:
            return ExceptionResponse(function, ExcCodes.GATEWAY_NO_RESPONSE)
        device.request(now_ns)
        if function in {23, 76} - {device.profile.exchange}:
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        try:
            message = self._decoder.decode(request[3:])
            if message is None:
                known = function in self._decoder.pdu_table
                code = ExcCodes.ILLEGAL_VALUE if known else ExcCodes.ILLEGAL_FUNCTION
                return ExceptionResponse(function, code)
            context: Any = _Context(device)  # all that the messages ask for
            return _finish(message.datastore_update(context, unit))
        except (ModbusException, struct.error, KeyError):
            return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)

    def refusal(self, request: bytes, code: int = ExcCodes.DEVICE_FAILURE) -> EmulatedReply:
        """Return an exception reply; by default, the code for a device failure."""
        return self._answered(ExceptionResponse(request[3], code), request)

    def written(self, request: bytes) -> set[str]:
        """See :meth:`~hilctl_drivers.emulator.wire.EmulatedWire.written`."""
        device = self._device(request)
        if device is None:
            return set()
        with suppress(struct.error):  # too short a message writes nothing
            return device.names(
                name for each in _writes(request[3:]) for name in device.written(*each)
            )
        return set()

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a reply whose damage must be detected."""
        return _CORRUPT_AT

    def _answered(self, reply: ModbusPDU, request: bytes) -> EmulatedReply:
        reply.transaction_id, reply.dev_id = struct.unpack_from(">HB", request)
        framed = self._framer.buildFrame(reply)
        return EmulatedReply(framed, wrong_id=lambda data: self._renamed(request, data))

    def _renamed(self, request: bytes, reply: bytes) -> bytes:
        """Return a reply in the name of another transaction (TCP) or unit (RTU)."""
        transaction, unit = struct.unpack_from(">HB", request)
        data = reply[7:] if self._kind == "tcp" else reply[1:-2]
        if self._kind == "tcp":
            return self._framer.encode(data, unit, (transaction + 1) & 0xFFFF)
        return self._framer.encode(data, unit % 247 + 1, 0)
