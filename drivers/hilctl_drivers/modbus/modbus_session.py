"""Talking to one Modbus device: registers by name of profile, and the profile's steps."""

import time
from collections.abc import Callable, Sequence
from typing import Literal

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.pdu import coil_pdu, read_pdu, write_pdu, write_single_pdu
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
        """Return what an output's register holds, in its unit; None where it can't be read.

        Raises:
            DeviceError: No answer, not a good one, or a refusal.
        """
        register = output.readback_register
        return None if register is None else register.format.decode(self.read_bytes(register))

    def run(self, steps: Sequence[ModbusStep]) -> None:
        """Carry out a profile's steps.

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
