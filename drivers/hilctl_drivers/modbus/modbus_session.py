"""Session with a Modbus device: registers, steps, exchange times, and the requests of a tick.

The requests of a tick are built once. A transaction keeps the constant part of its request and of
its good reply. A tick adds transaction id, data and CRC, and compares. Only a reply that differs is
parsed by :mod:`hilctl_drivers.modbus.pdu`, which raises the error.
"""

import math
import struct
import time
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias, cast

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac_setup import SessionReader
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
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport.crc import MODBUS_WORDS, Bytes, crc16_modbus
from hilctl_drivers.transport.links import CorruptError, IncompleteError, Link, RefusedError
from hilctl_drivers.transport.wire_time import WireTime

_tcp_start = struct.Struct(">HH").unpack_from


class _Prepared:
    """A prepared request and the check of its reply; what is the same in all is kept."""

    def __init__(self, adu: bytes, pdu: bytes, start: int) -> None:
        """Take the first request, its PDU, and where in the request the PDU begins."""
        self.pdu = pdu
        """The first request; later ones differ in the data only."""
        first = modbus.DATA_AT.get(pdu[0], len(pdu))
        head, read_size = modbus.reply_layout(pdu)
        self._last = adu
        self._data = pdu[first:]
        self._data_size = len(self._data)
        self._before = adu[: start + first]
        # The reply to a single write echoes all of the request.
        self._echo = pdu[0] == modbus.WRITE_REGISTER
        self._head = adu[:start] + head
        self._read_size = read_size
        self.reply_size = len(self._head) + read_size
        """Bytes of a good reply."""


class TcpTransaction(_Prepared):
    """A prepared Modbus TCP request; each has the next transaction id."""

    def __init__(self, unit: int, pdu: bytes, transaction: int = 0) -> None:
        """Prepare ``pdu`` for ``unit``; the first request's id is ``transaction`` + 1."""
        super().__init__(modbus.tcp_adu(transaction, unit, pdu), pdu, modbus.TCP_HEAD)
        self._unit = unit
        self._transaction = transaction
        self._before = self._before[2:]
        length = (self.reply_size - 6).to_bytes(2, "big")
        self._head = self._head[2:4] + length + self._head[6:]
        self._join = struct.Struct(f">H{len(self._before)}s{self._data_size}s").pack
        self._split = struct.Struct(f">H{len(self._head)}s{self._read_size}s").unpack

    def request(self, data: bytes = b"") -> bytes:
        """Return the next request; without ``data`` it writes those of the last call."""
        if data:
            self._data = data
            if self._echo:
                self._head = self._head[:-2] + data
        self._transaction = transaction = (self._transaction + 1) & 0xFFFF
        self._last = made = self._join(transaction, self._before, self._data)
        return made

    def reply(self, adu: Bytes) -> bytes:
        """Return the register bytes in the reply to the last request, or raise FrameError."""
        if len(adu) == self.reply_size:
            transaction, head, read = self._split(adu)
            if transaction == self._transaction and head == self._head:
                return cast(bytes, read)
        pdu = modbus.tcp_pdu(adu, self._transaction, self._unit)
        return modbus.reply_data(self._last[modbus.TCP_HEAD :], pdu)

    def missing(self, received: Bytes) -> int:
        """Return the number of missing bytes; 0 if the reply is complete, or is no Modbus TCP."""
        count = len(received)
        if count <= modbus.TCP_HEAD:
            return modbus.TCP_HEAD + 1 - count
        protocol, length = _tcp_start(received, 2)
        if protocol or length > modbus.PDU_MAX + 1:
            return 0
        return max(0, int(length) + 6 - count)


class RtuTransaction(_Prepared):
    """A prepared Modbus RTU request; there is no id to tell a late reply by.

    CRCs of what never changes are computed once; the rest is taken two bytes at a time.
    """

    def __init__(self, unit: int, pdu: bytes) -> None:
        """Prepare ``pdu`` for ``unit``."""
        super().__init__(modbus.rtu_adu(unit, pdu), pdu, 1)
        self._unit = unit
        self.reply_size += 2
        self._before_crc = crc16_modbus(self._before)
        self._head_crc = crc16_modbus(self._head)
        self._join = struct.Struct(f"<{len(self._before)}s{self._data_size}sH").pack
        self._split = struct.Struct(f"<{len(self._head)}s{self._read_size}sH").unpack
        self._written_words = struct.Struct(f"<{self._data_size // 2}H").unpack
        self._read_words = struct.Struct(f"<{self._read_size // 2}H").unpack
        self._in_words = self._read_size % 2 == 0  # bits may not be

    def request(self, data: bytes = b"") -> bytes:
        """Return the next request; without ``data`` it writes those of the last call."""
        if not data:
            return self._last
        table, crc = MODBUS_WORDS, self._before_crc
        for word in self._written_words(data):
            crc = table[crc ^ word]
        if self._echo:
            self._head = self._head[:-2] + data
            self._head_crc = crc16_modbus(self._head)
        self._last = made = self._join(self._before, data, crc)
        return made

    def reply(self, adu: Bytes) -> bytes:
        """Return the register bytes in the reply to the last request, or raise FrameError."""
        if len(adu) == self.reply_size and self._in_words:
            head, read, sent = self._split(adu)
            if head == self._head:
                table, crc = MODBUS_WORDS, self._head_crc
                for word in self._read_words(read):
                    crc = table[crc ^ word]
                if crc == sent:
                    return cast(bytes, read)
        if adu[: len(self._last)] == self._last and not self._echo:
            raise CorruptError(
                "the request came back before the reply: the adapter echoes, or receives what it "
                "sends; set echo: true beside the address"
            )
        missing = self.missing(adu)
        if missing:
            raise IncompleteError(f"{missing} more bytes belong to the reply")
        return modbus.reply_data(self._last[1:-2], modbus.rtu_pdu(adu, self._unit))

    def missing(self, received: Bytes) -> int:
        """Return the number of missing bytes; 0 if the reply is complete."""
        count = len(received)
        if count < modbus.RTU_SHORTEST:
            return modbus.RTU_SHORTEST - count
        return 0 if received[1] & 0x80 else max(0, self.reply_size - count)


Transaction: TypeAlias = TcpTransaction | RtuTransaction


def read_request(profile: ModbusProfile, register: Register) -> bytes:
    """Return the PDU that reads a register, and the validity of an input beside it."""
    return modbus.read_pdu(register.read_function, *profile.span(register))


def write_request(profile: ModbusProfile, register: Register, data: bytes = b"") -> bytes:
    """Return the PDU that writes a register; zeros without ``data``."""
    address = profile.wire_address(register)
    data = data or bytes(2 * register.words)
    if register.type == "bit":
        return modbus.coil_pdu(address, any(data))
    single = register.words == 1
    if isinstance(register, ModbusOutput):
        single = register.function == 6
    return (modbus.write_single_pdu if single else modbus.write_pdu)(address, data)


def combined_request(
    profile: ModbusProfile, output: ModbusOutput, sensor: ModbusInput
) -> bytes | None:
    """Return the PDU that writes an output and reads an input; None if the device has none."""
    source, target = profile.span(sensor), profile.wire_address(output)
    data = bytes(2 * output.words)
    if profile.exchange == 23:
        return modbus.write_read_pdu(*source, target, data)
    if profile.exchange == 76:
        return modbus.feedback_pdu(modbus.read_frame(*source), modbus.write_frame(target, data))
    return None


class ModbusSession:
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
        self._feedbacks = 0

    def prepare(self, pdu: bytes) -> Transaction:
        """Return a request that can be sent many times."""
        if self._framing == "tcp":
            return TcpTransaction(self.unit, pdu)
        return RtuTransaction(self.unit, pdu)

    def call(self, transaction: Transaction, data: bytes = b"") -> bytes:
        """Send a prepared request with register bytes to write; return those that were read."""
        request, usual = transaction.request(data), transaction.reply_size
        try:
            return transaction.reply(self.link.transact(request, transaction.missing, usual))
        except RefusedError as error:
            raise RefusedError(f"{error}{self._keys(transaction.pdu)}", error.code) from None

    def feedback(self, *frames: bytes) -> list[bytes]:
        """Execute frames with function 76 in one message; return the bytes of each read frame.

        After a refusal of a frame, those before it may have been executed.
        """
        pdu = modbus.feedback_pdu(*frames)
        transaction = TcpTransaction(self.unit, pdu, self._feedbacks)
        self._feedbacks = (self._feedbacks + 1) & 0xFFFF
        words = "".join(f"{size}s" for size in modbus.feedback_sizes(pdu))
        return list(struct.unpack(words, self.call(transaction)))

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
        data = self.call(self.prepare(read_request(self.profile, register)))
        return bytes([data[0] & 1]) if register.type == "bit" else data

    def write_bytes(self, register: Register, data: bytes) -> None:
        """Write what :meth:`read_bytes` returns."""
        self.call(self.prepare(write_request(self.profile, register, data)))

    def held_data(self, output: ModbusOutput) -> bytes | None:
        """Return the register bytes that write what an output holds; None if not known."""
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
                raise DeviceError(f"{step.value} was written, but {_decoded(step, found):g} stands")

    def would_change(self, steps: Sequence[ModbusStep]) -> bool:
        """Return whether an ensure step among these would write."""
        return any(
            isinstance(step, EnsureStep) and self.read_bytes(step) != _encoded(step, step.value)
            for step in steps
        )

    def check_selftest(self) -> None:
        """Raise DeviceError if the register of known content holds something else."""
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

    def decoder(self, source: ModbusInput) -> Callable[[bytes], float]:
        """Return the conversion of the bytes that :func:`read_request` reads for an input.

        The value is NaN if the validity register, which may be read separately, shows that.
        """
        decode, validity = source.format.decode, source.validity
        if validity == "none":
            return decode
        bits, valid = validity.bits, validity.valid
        start, words = self.profile.span(source)
        if words == source.words:
            request = self.prepare(read_request(self.profile, validity))
            # Afterwards: a reading that has become invalid in between is not used.
            return lambda data: decode(data) if bits(self.call(request)) == valid else math.nan

        def part(register: Register) -> slice:
            first = 2 * (self.profile.wire_address(register) - start)
            return slice(first, first + 2 * register.words)

        own, other = part(source), part(validity)
        return lambda data: decode(data[own]) if bits(data[other]) == valid else math.nan

    def input_reader(self, source: ModbusInput) -> Callable[[], float]:
        """Return a function that reads an input, NaN if it is invalid."""
        request, decode = self.prepare(read_request(self.profile, source)), self.decoder(source)
        return lambda: decode(self.call(request))

    def set_digital(self, output: DigitalRegister, high: bool) -> None:
        """Write 1 or 0 to a digital output."""
        self.write_bytes(output, _encoded(output, float(high)))

    def is_high(self, source: DigitalRegister) -> bool:
        """Return whether a digital input is not 0."""
        return any(self.read_bytes(source))

    def error_check(self) -> Callable[[], None] | None:
        """Return a function that raises RefusedError if the error register is not 0, if any."""
        register = self.profile.error_register
        if register == "none":
            return None
        request = self.prepare(read_request(self.profile, register))
        place = f"{register.area} {register.address}"

        def check() -> None:
            found = register.bits(self.call(request))
            if found:
                raise RefusedError(f"the error register, {place}, holds {found:#x}", found)

        return check


def _encoded(register: Register, value: float | str) -> bytes:
    assert isinstance(value, float), "watchdog steps are bound to numbers first"
    return bytes([value != 0.0]) if register.type == "bit" else register.format.encode(value)


def _decoded(register: Register, data: bytes) -> float:
    return float(data[0]) if register.type == "bit" else register.format.decode(data)


def _named(step: RegisterStep) -> str:
    note = f" ({step.note})" if step.note else ""
    return f"{type(step).__name__.removesuffix('Step').lower()} {step.area} {step.address}{note}"


def exchange_time(
    profile: ModbusProfile, output: str, sensor: str | None, *, one_transaction: bool = True
) -> WireTime:
    """Return the time to write an output and read an input, by name; None to write only."""
    written = profile.outputs[output]
    write = write_request(profile, written)
    after = []
    if profile.error_register != "none":
        after = [read_request(profile, profile.error_register)]
    if sensor is None:
        return _requests_time(profile, [write, *after], written.settle_s)
    read = profile.inputs[sensor]
    reads, combined = read_requests(profile, read), combined_request(profile, written, read)
    both = [combined, *reads[1:]] if combined and one_transaction else [*reads, write]
    return _requests_time(profile, [*both, *after], written.settle_s + read.settle_s)


def read_time(profile: ModbusProfile, source: ModbusInput) -> WireTime:
    """Return the time to read an input."""
    return _requests_time(profile, read_requests(profile, source), source.settle_s)


def digital_time(profile: ModbusProfile, output: DigitalRegister) -> WireTime:
    """Return the time to set a digital output."""
    return _requests_time(profile, [write_request(profile, output)])


def read_requests(profile: ModbusProfile, sensor: ModbusInput) -> list[bytes]:
    """Return the requests that read an input, and its validity if that is elsewhere."""
    requests, validity = [read_request(profile, sensor)], sensor.validity
    if validity != "none" and profile.span(sensor)[1] == sensor.words:
        requests.append(read_request(profile, validity))
    return requests


def _requests_time(
    profile: ModbusProfile, requests: Sequence[bytes], settle_s: float = 0.0
) -> WireTime:
    """Return the time of request PDUs and their replies, one after the other."""
    what = "+".join(f"FC{pdu[0]:02d}" for pdu in requests)
    sent = sum(len(modbus.rtu_adu(1, pdu)) for pdu in requests)
    received = sum(modbus.reply_size(pdu) + 3 for pdu in requests)  # unit and CRC
    count = len(requests)
    return profile.wire_time(what, sent, received, 2 * count, count, settle_s)


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


class ModbusReader(SessionReader):
    """A :class:`~hilctl_drivers.dac_setup.SensorReader` for Modbus."""

    time = staticmethod(read_time)
    digital_time = staticmethod(digital_time)

    @staticmethod
    def session_on(endpoint: Endpoint, link: Link) -> ModbusSession:
        """See :meth:`~hilctl_drivers.dac_setup.SessionReader.session_on`."""
        assert endpoint.unit is not None, "Modbus devices have an address"
        framing: Literal["tcp", "rtu"] = "tcp" if endpoint.framing == "tcp" else "rtu"
        profile = cast(ModbusProfile, endpoint.profile)
        return ModbusSession(profile, link, endpoint.unit, framing=framing)

    @staticmethod
    def steps_time(profile: ModbusProfile, steps: Sequence[ModbusStep]) -> WireTime:
        """See :meth:`~hilctl_drivers.dac_setup.SessionReader.steps_time`."""
        requests = [pdu for step in steps for pdu in _step_requests(profile, step)]
        waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
        return _requests_time(profile, requests).waiting(waits_s)
