"""Session with a Modbus device: registers, steps, and exchange times."""

import time
from collections.abc import Callable, Sequence
from typing import Literal

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.modbus_profile import (
    ModbusInput,
    ModbusOutput,
    ModbusProfile,
    ModbusRtuLink,
)
from hilctl_drivers.modbus.pdu import (
    coil_pdu,
    feedback_pdu,
    read_pdu,
    reply_size,
    rtu_adu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.prepared_requests import RtuTransaction, TcpTransaction, Transaction
from hilctl_drivers.modbus.register_map import (
    EnsureStep,
    ExpectStep,
    ModbusStep,
    Register,
    RegisterStep,
    TripFlag,
)
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport.links import Link
from hilctl_drivers.transport.wire_time import WireTime


class ModbusSession:
    """A link to one device, asked one thing at a time.

    Args:
        profile: What the device is.
        link: Not yet open.
        unit: Its unit id.
        sleep: Waits that many s.
        framing: Of the link, where it is not the profile's: a gateway takes Modbus TCP to devices
            on a serial line.
    """

    def __init__(
        self,
        profile: ModbusProfile,
        link: Link,
        unit: int,
        sleep: Callable[[float], None] = time.sleep,
        *,
        framing: Literal["tcp", "rtu"] | None = None,
    ) -> None:
        self._profile = profile
        self._framing = framing or profile.link.kind
        self._link = link
        self._unit = unit
        self._sleep = sleep

    @property
    def link(self) -> Link:
        """The link."""
        return self._link

    @property
    def profile(self) -> ModbusProfile:
        """What the device is."""
        return self._profile

    def prepare(self, pdu: bytes) -> Transaction:
        """Return a request that can be sent many times."""
        if self._framing == "tcp":
            return TcpTransaction(self._unit, pdu)
        return RtuTransaction(self._unit, pdu)

    def call(self, transaction: Transaction, data: bytes = b"") -> bytes:
        """Send a prepared request and return the register bytes that were read.

        Args:
            transaction: The request.
            data: Register bytes to write.

        Raises:
            DeviceError: No answer, not a good one, or a refusal.
        """
        request, usual = transaction.request(data), transaction.reply_size
        return transaction.reply(self._link.transact(request, transaction.missing, usual))

    def read_bytes(self, register: Register) -> bytes:
        """Return what a register holds, as bytes; a bit as one byte, 0 or 1."""
        address = self._profile.wire_address(register)
        pdu = read_pdu(register.read_function, address, register.words)
        data = self.call(self.prepare(pdu))
        return bytes([data[0] & 1]) if register.type == "bit" else data

    def write_bytes(self, register: Register, data: bytes) -> None:
        """Write what :meth:`read_bytes` returns."""
        address = self._profile.wire_address(register)
        if register.type == "bit":
            pdu = coil_pdu(address, data != b"\0")
        elif register.words == 1:
            pdu = write_single_pdu(address, data)
        else:
            pdu = write_pdu(address, data)
        self.call(self.prepare(pdu))

    def put_out(self, output: ModbusOutput, data: bytes) -> None:
        """Write an output's register bytes.

        Raises:
            DeviceError: The device does not confirm.
        """
        self.call(self.prepare(self.output_pdu(output, data)))

    def output_pdu(self, output: ModbusOutput, data: bytes) -> bytes:
        """Return the request that writes an output's register bytes."""
        address = self._profile.wire_address(output)
        return (write_single_pdu if output.function == 6 else write_pdu)(address, data)

    def held(self, output: ModbusOutput) -> float | None:
        """Return what an output's register holds, in its unit; None if it cannot be read.

        Raises:
            DeviceError: No answer, not a good one, or a refusal.
        """
        register = output.readback_register
        return None if register is None else register.format.decode(self.read_bytes(register))

    def run(self, steps: Sequence[ModbusStep]) -> None:
        """Execute a profile's steps.

        Raises:
            DeviceError: One of them failed; the text says which.
        """
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
        """Read the register of known content.

        Raises:
            DeviceError: It holds something else.
        """
        test = self._profile.selftest
        if test == "none":
            return
        found = self.read_bytes(test)
        if found != _encoded(test, test.expect):
            raise DeviceError(
                f"self-test register {test.address} must hold {test.expect:g}, got "
                f"{_decoded(test, found):g}: another device, or another byte order than the "
                "profile's"
            )

    def is_set(self, flag: TripFlag) -> bool:
        """Return whether a flag says yes."""
        found = self.read_bytes(flag)
        return bool(int.from_bytes(found, "big") & flag.mask)


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
    """Return what one exchange costs: write an output and read an input.

    Args:
        profile: The device; see :func:`hilctl_drivers.profile.with_link` for another baud or gap.
        output: Name of the output.
        sensor: Name of the input; None to write only.
        one_transaction: Whether the exchange in one transaction may be used, where there is one.

    Raises:
        KeyError: No such output or input.
    """
    written = profile.outputs[output]
    read = None if sensor is None else profile.inputs[sensor]
    requests = _requests(profile, written, read, one_transaction=one_transaction)
    settle_s = written.settle_s + (read.settle_s if read else 0.0)
    return requests_time(profile, requests, settle_s)


def read_time(profile: ModbusProfile, sensor: ModbusInput) -> WireTime:
    """Return what it costs to read an input."""
    pdu = read_pdu(sensor.read_function, profile.wire_address(sensor), sensor.words)
    return requests_time(profile, [pdu], sensor.settle_s)


def feed_time(profile: ModbusProfile) -> WireTime | None:
    """Return the time to feed the device's watchdog once; None if exchanges feed it."""
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    return _steps_time(profile, watchdog.feed).named("to feed the watchdog")


def arm_s(profile: ModbusProfile, output: str) -> float:
    """Return the time that arming the device's watchdog takes at most, s; 0 without a watchdog."""
    watchdog = profile.watchdog
    if watchdog == "none":
        return 0.0
    wire = _steps_time(profile, (*watchdog.unlock, *watchdog.safe.get(output, ()), *watchdog.arm))
    return wire.answered_s


def requests_time(
    profile: ModbusProfile, requests: Sequence[bytes], settle_s: float = 0.0
) -> WireTime:
    """Return what requests cost with their replies, one after the other.

    Args:
        profile: The device.
        requests: Their PDUs.
        settle_s: Time that the terminals take to settle.
    """
    what = "+".join(f"FC{pdu[0]:02d}" for pdu in requests)
    turnaround_s = len(requests) * profile.turnaround_s
    link = profile.link
    if not isinstance(link, ModbusRtuLink):
        return WireTime(f"{what} over TCP", 0.0, 0.0, 0, 0.0, turnaround_s, settle_s=settle_s)
    sent = sum(len(rtu_adu(1, pdu)) for pdu in requests)
    received = sum(reply_size(pdu) + 3 for pdu in requests)  # unit and CRC
    gaps = 2 * len(requests)
    return WireTime(
        f"{what} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        gaps,
        gaps * link.silence_s,
        turnaround_s,
        settle_s=settle_s,
    )


def _requests(
    profile: ModbusProfile,
    output: ModbusOutput,
    sensor: ModbusInput | None,
    *,
    one_transaction: bool,
) -> list[bytes]:
    at, data = profile.wire_address(output), bytes(2 * output.words)
    if sensor is not None:
        source = profile.wire_address(sensor)
        if one_transaction and profile.exchange == 23:
            return [write_read_pdu(source, sensor.words, at, data)]
        if one_transaction and profile.exchange == 76:
            return [feedback_pdu(at, data, source, sensor.words)]
    write = write_single_pdu(at, data) if output.function == 6 else write_pdu(at, data)
    if sensor is None:
        return [write]
    return [read_pdu(sensor.read_function, source, sensor.words), write]


def _step_requests(profile: ModbusProfile, step: ModbusStep) -> list[bytes]:
    """Return the requests of a step, with the longest that it may come to."""
    if isinstance(step, WaitStep):
        return []
    address, data = profile.wire_address(step), bytes(2 * step.words)
    read = read_pdu(step.read_function, address, step.words)
    if isinstance(step, ExpectStep):
        return [read]
    if step.type == "bit":
        write = coil_pdu(address, True)
    else:
        write = (write_single_pdu if step.words == 1 else write_pdu)(address, data)
    if isinstance(step, EnsureStep):
        return [read, write, read]
    return [write, read] if step.verify else [write]


def _steps_time(profile: ModbusProfile, steps: Sequence[ModbusStep]) -> WireTime:
    """Return the longest that steps take; one that writes only a difference counts as a write."""
    requests = [pdu for step in steps for pdu in _step_requests(profile, step)]
    waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
    return requests_time(profile, requests).waiting(waits_s)
