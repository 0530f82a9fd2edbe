"""Session with a Modbus device: registers, steps, exchange times, and the requests of a tick.

The requests of a tick are prepared once, as functions that keep the constant parts of the request
and of its good reply. A tick adds number, data and CRC, and compares the reply. Only a different
reply is parsed by :mod:`hilctl_drivers.modbus.pdu`, which raises the error.
"""

import itertools
import struct
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, cast

from hilctl.base.errors import DeviceError
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.modbus import pdu as modbus
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.register_map import (
    DigitalRegister,
    EnsureStep,
    ExpectStep,
    ModbusStep,
    Register,
    RegisterStep,
    StatusRegister,
)
from hilctl_drivers.modbus.tick_plan import (
    Call,
    Tick,
    TickPlan,
    read_request,
    requests_time,
    write_request,
)
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.session import SteppedSession
from hilctl_drivers.transport.crc import MODBUS_WORDS, Bytes, crc16_modbus
from hilctl_drivers.transport.links import (
    ECHOED,
    CorruptError,
    IncompleteError,
    Link,
    RefusedError,
)
from hilctl_drivers.transport.wire_time import WireTime

_tcp_start = struct.Struct(">HH").unpack_from


def _tcp_call(session: "ModbusSession", pdu: bytes) -> Call:
    """Return a function that sends a PDU by Modbus TCP, each time with the next number."""
    unit, numbers, transact = session.unit, session.numbers, session.link.transact
    data_at, (head, read_size) = modbus.data_at(pdu), modbus.reply_layout(pdu)
    own, before = pdu[data_at:], modbus.tcp_adu(0, unit, pdu)[2 : modbus.TCP_HEAD + data_at]
    echoes = pdu[0] == modbus.WRITE_REGISTER
    head = modbus.tcp_adu(0, unit, head + bytes(read_size))[2 : modbus.TCP_HEAD + len(head)]
    usual = 2 + len(head) + read_size
    join = struct.Struct(f">H{len(before)}s{len(own)}s").pack
    split = struct.Struct(f">H{len(head)}s{read_size}s").unpack

    def call(data: bytes = own) -> bytes:
        number = next(numbers) & 0xFFFF
        request = join(number, before, data)
        adu = transact(request, _tcp_missing, usual)
        if echoes:  # the good reply is the request
            if adu == request:
                return b""
        elif len(adu) == usual:
            read: bytes
            found_number, found, read = split(adu)
            if found_number == number and found == head:
                return read
        return session.read_data(request[modbus.TCP_HEAD :], modbus.tcp_pdu(adu, number, unit))

    return call


def _tcp_missing(received: Bytes) -> int:
    """Return the number of missing bytes; 0 if the reply is complete, or is no Modbus TCP."""
    size = len(received)
    if size <= modbus.TCP_HEAD:
        return modbus.TCP_HEAD + 1 - size
    protocol, length = _tcp_start(received, 2)
    if protocol or length > modbus.PDU_MAX + 1:
        return 0
    return max(0, int(length) + 6 - size)


def _rtu_call(session: "ModbusSession", pdu: bytes) -> Call:
    """Return a function that sends a PDU by Modbus RTU; it has no number to detect a late reply.

    CRCs of constant bytes are computed once; the others two bytes at a time.
    """
    unit, transact, table = session.unit, session.link.transact, MODBUS_WORDS
    data_at, (head, read_size) = modbus.data_at(pdu), modbus.reply_layout(pdu)
    own, before = pdu[data_at:], modbus.rtu_adu(unit, pdu)[: 1 + data_at]
    echoes = pdu[0] == modbus.WRITE_REGISTER
    head = before[:1] + head
    before_crc, head_crc = crc16_modbus(before), crc16_modbus(head)
    usual = len(head) + read_size + 2
    join = struct.Struct(f"<{len(before)}s{len(own)}sH").pack
    split = struct.Struct(f"<{len(head)}s{read_size}sH").unpack
    written_words = struct.Struct(f"<{len(own) // 2}H").unpack
    read_words = struct.Struct(f"<{read_size // 2}H").unpack
    in_words = not echoes and read_size % 2 == 0  # bits may not be
    missing = partial(_rtu_missing, usual)

    def call(data: bytes = own) -> bytes:
        crc = before_crc
        for word in written_words(data):
            crc = table[crc ^ word]
        request = join(before, data, crc)
        adu = transact(request, missing, usual)
        if echoes and adu == request:
            return b""
        if in_words and len(adu) == usual:
            read: bytes
            found, read, sent = split(adu)
            if found == head:
                crc = head_crc
                for word in read_words(read):
                    crc = table[crc ^ word]
                if crc == sent:
                    return read
        lacking = missing(adu)
        # The reply may be shorter than the request: then it ends before the echo does.
        if adu.startswith(request if lacking else request[: len(adu)]):
            raise CorruptError(ECHOED)
        if lacking:
            raise IncompleteError(f"{lacking} bytes of the reply are missing")
        return session.read_data(request[1:-2], modbus.rtu_pdu(adu, unit))

    return call


def _rtu_missing(usual: int, received: Bytes) -> int:
    """Return the number of bytes missing from a reply that normally has ``usual`` bytes."""
    size = len(received)
    if size < modbus.RTU_SHORTEST:
        return modbus.RTU_SHORTEST - size
    return 0 if received[1] & 0x80 else max(0, usual - size)


class ModbusSession(SteppedSession):
    """A link to one device, with one request at a time; every error is a ``DeviceError``."""

    def __init__(
        self,
        profile: ModbusProfile,
        link: Link,
        unit: int,
        sleep: Callable[[float], None] = time.sleep,
        *,
        framing: Literal["tcp", "rtu"],
    ) -> None:
        self.profile = profile
        self.link = link
        self._framing = framing
        self.unit = unit
        self._sleep = sleep
        self.numbers = itertools.count(1)
        """Numbers of Modbus TCP requests."""

    @classmethod
    def on(cls, device: Endpoint, link: Link) -> "ModbusSession":
        """See :meth:`~hilctl_drivers.session.Session.on`."""
        assert device.unit is not None, "Modbus devices have an address"
        framing: Literal["tcp", "rtu"] = "tcp" if device.framing == "tcp" else "rtu"
        return cls(cast(ModbusProfile, device.profile), link, device.unit, framing=framing)

    @staticmethod
    def read_time(profile: ModbusProfile, source: ModbusInput) -> WireTime:
        """See :meth:`~hilctl_drivers.session.Session.read_time`."""
        return TickPlan(profile, inputs=[source]).time

    @staticmethod
    def request(device: Endpoint, source: ModbusInput) -> bytes:
        """See :meth:`~hilctl_drivers.session.Session.request`; those of Modbus TCP are numbered."""
        pdu = read_request(cast(ModbusProfile, device.profile), source)
        return modbus.rtu_adu(device.unit or 0, pdu) if device.framing == "rtu" else b""

    @staticmethod
    def digital_time(profile: ModbusProfile, output: DigitalRegister) -> WireTime:
        """See :meth:`~hilctl_drivers.session.SteppedSession.digital_time`."""
        return requests_time(profile, [write_request(profile, output)])

    @staticmethod
    def steps_time(profile: ModbusProfile, steps: Sequence[ModbusStep]) -> WireTime:
        """See :meth:`~hilctl_drivers.session.SteppedSession.steps_time`."""
        requests = [pdu for step in steps for pdu in _step_requests(profile, step)]
        waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
        return requests_time(profile, requests).waiting(waits_s)

    def prepare(self, pdu: bytes) -> Call:
        """Return a function that sends a request, and can be called many times."""
        return (_tcp_call if self._framing == "tcp" else _rtu_call)(self, pdu)

    def read_data(self, request_pdu: bytes, reply_pdu: bytes) -> bytes:
        """Return :func:`hilctl_drivers.modbus.pdu.reply_data`; a refusal names keys."""
        try:
            return modbus.reply_data(request_pdu, reply_pdu)
        except RefusedError as error:
            raise RefusedError(f"{error}{self._keys(request_pdu)}", error.code) from None

    def feedback(self, *frames: bytes) -> list[bytes]:
        """Execute frames with function 76 in one message; return the bytes of each read frame.

        After a refusal of a frame, those before it may have been executed.
        """
        pdu = modbus.feedback_pdu(*frames)
        words = "".join(f"{size}s" for size in modbus.feedback_sizes(pdu))
        return list(struct.unpack(words, self.prepare(pdu)()))

    def _keys(self, pdu: bytes) -> str:
        """Return the keys of registers at the address of a request; none for functions 23, 76."""
        address = int.from_bytes(pdu[1:3], "big")
        keys = [
            key
            for key, register in self.profile.registers()
            if pdu[0] in {register.read_function, *modbus.PLAIN_WRITES}
            and self.profile.wire_address(register) == address
        ]
        return f" ({', '.join(keys)} in the profile)" if keys else ""

    def read_bytes(self, register: Register) -> bytes:
        """Return the content of a register as bytes; a bit as one byte, 0 or 1."""
        data = self.prepare(read_request(self.profile, register))()
        return bytes([data[0] & 1]) if register.type == "bit" else data

    def write_bytes(self, register: Register, data: bytes) -> None:
        """Write data in the form that :meth:`read_bytes` returns."""
        self.prepare(write_request(self.profile, register, data))()

    def held_data(self, output: ModbusOutput) -> bytes | None:
        """Return the register bytes that rewrite the present output; None if unknown."""
        register = output.readback_register
        if register is None:
            return None
        data = self.read_bytes(register)
        if register.format == output.format:
            return data
        value = register.format.decode(data)
        return output.format.encode(value) if output.min <= value <= output.max else None

    def held(self, output: ModbusOutput) -> float | None:
        """Return the content of an output's register, in its unit; None if it cannot be read."""
        register = output.readback_register
        return None if register is None else register.format.decode(self.read_bytes(register))

    def run(self, steps: Sequence[ModbusStep]) -> None:
        """Execute a profile's steps; an error names the step."""
        for step in steps:
            if isinstance(step, WaitStep):
                self._sleep(step.seconds)
                continue
            try:
                self._step(step)
            except DeviceError as error:
                raise DeviceError(f"{error}, at step {_named(step)}") from None

    def _step(self, step: RegisterStep) -> None:
        wanted = _encoded(step, step.value)
        if isinstance(step, ExpectStep | EnsureStep):
            found = self.read_bytes(step)
            if found == wanted:
                return
            if isinstance(step, ExpectStep):
                raise DeviceError(f"must hold {step.value}, got {_decoded(step, found):g}")
        self.write_bytes(step, wanted)
        if isinstance(step, EnsureStep) or getattr(step, "verify", False):
            found = self.read_bytes(step)
            if found != wanted:
                got = f"{_decoded(step, found):g} was read back"
                raise DeviceError(f"{step.value} was written, but {got}")

    def would_change(self, steps: Sequence[ModbusStep]) -> bool:
        """Return whether an ensure step among these would write."""
        return any(
            isinstance(step, EnsureStep) and self.read_bytes(step) != _encoded(step, step.value)
            for step in steps
        )

    def identify(self) -> None:
        """Raise DeviceError if the self-test register does not have its known content."""
        test = self.profile.selftest
        if test == "none":
            return
        found = self.read_bytes(test)
        if found != _encoded(test, test.expect):
            raise DeviceError(
                f"self-test register {test.address} must hold {test.expect:g}, got "
                f"{_decoded(test, found):g}: another device, or another byte order than the "
                "profile's"
            )

    def is_set(self, flag: StatusRegister) -> bool:
        """Return whether a bit of the flag's mask is set."""
        return flag.bits(self.read_bytes(flag)) != 0

    def input_reader(self, source: ModbusInput) -> Callable[[], float]:
        """Return a function that reads an input, NaN if it is invalid."""
        tick = self.tick(TickPlan(self.profile, inputs=[source]))
        value = tick.reader(source)

        def read() -> float:
            tick.run()
            return value()

        return read

    def set_digital(self, output: DigitalRegister, high: bool) -> None:
        """Write 1 or 0 to a digital output."""
        self.write_bytes(output, _encoded(output, float(high)))

    def is_high(self, source: DigitalRegister) -> bool:
        """Return whether a digital input is not 0."""
        return any(self.read_bytes(source))

    def tick(self, plan: TickPlan) -> Tick:
        """Return a prepared plan, which checks the error register after a write."""
        register = self.profile.error_register
        checks = bool(plan.outputs) and register != "none"
        return Tick(plan, self.prepare, self._check_error if checks else None)

    def old_errors(self) -> list[str]:
        """Return the content of the error register if it is not 0; reading may clear it."""
        register = self.profile.error_register
        try:
            if register != "none":
                self._check_error(self.read_bytes(register))
        except RefusedError as error:
            return [str(error)]
        return []

    def _check_error(self, content: bytes) -> None:
        """Raise RefusedError if the content of the error register is not 0."""
        register = self.profile.error_register
        if register != "none" and (found := register.bits(content)):
            place = f"{register.area} {register.address}"
            raise RefusedError(f"the error register, {place}, holds {found:#x}", found)


def _encoded(register: Register, value: float | str) -> bytes:
    assert isinstance(value, float), "watchdog steps are bound to numbers first"
    return bytes([value != 0.0]) if register.type == "bit" else register.format.encode(value)


def _decoded(register: Register, data: bytes) -> float:
    return float(data[0]) if register.type == "bit" else register.format.decode(data)


def _named(step: RegisterStep) -> str:
    note = f" ({step.note})" if step.note else ""
    return f"{type(step).__name__.removesuffix('Step').lower()} {step.area} {step.address}{note}"


def _step_requests(profile: ModbusProfile, step: ModbusStep) -> list[bytes]:
    """Return the most requests that a step may send."""
    if isinstance(step, WaitStep):
        return []
    read, write = read_request(profile, step), write_request(profile, step)
    if isinstance(step, ExpectStep):
        return [read]
    if isinstance(step, EnsureStep):
        return [read, write, read]
    return [write, read] if step.verify else [write]
