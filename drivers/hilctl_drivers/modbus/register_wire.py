"""Wire to a DAC and an ADC in registers, on Modbus TCP or RTU.

The profile describes the registers, the experiment their wiring. A sample is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device, of any protocol, may have the input. No request is repeated, and none precedes the
last reply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias, cast

import numpy as np

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import (
    ModbusSession,
    combined_request,
    exchange_time,
    read_requests,
    write_request,
)
from hilctl_drivers.modbus.pdu import rtu_adu
from hilctl_drivers.modbus.register_watchdog import RegisterWatchdog
from hilctl_drivers.session import SensorReader
from hilctl_drivers.transport.links import NoAnswerError, RefusedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wire import Wire

Swap: TypeAlias = Callable[[bytes], float]
"""Write register bytes to the output and return the value of the input in its unit.

The input is read first, so it does not show the new output yet. Function 23 is an exception: the
specification lets the device write first.
"""


class RegisterWire(Wire):
    """A :class:`~hilctl_drivers.wire.Wire` to registers."""

    session: ModbusSession

    def __init__(self, setup: DacSetup, link: Any) -> None:
        super().__init__(setup, link)
        self.session = session = ModbusSession.on(setup.writer, link)
        self._profile: ModbusProfile = session.profile
        self._target = target = cast(ModbusOutput, setup.output)
        self.watchdog: RegisterWatchdog = RegisterWatchdog(setup, session)
        readback = target.readback_register
        if readback is None and target.function == 6 and setup.writer.framing == "rtu":
            # The correct reply equals the request, as does an echo on the line.
            self.unconfirmed = (
                "the device cannot confirm it: on a serial line the reply to function 6 may be an "
                "echo, and the output cannot be read back"
            )
        # One transaction is tried at open. That moves an output that cannot be read back, so it is
        # not tried there.
        self._may_combine = (
            self._profile.exchange != "none" and readback is not None and not setup.reads_elsewhere
        )
        self.reads_output = readback is not None
        self._factors, self._encode = setup.chain.factors, target.format.encode
        self._swap: Swap
        self._one_transaction = self._may_combine  # as far as is known; opening it shows
        setup.check_timeout(self._time(self._may_combine))

    def _time(self, one_transaction: bool) -> WireTime:
        """Return the time of a sample on the wire."""
        setup, profile = self.setup, self._profile
        own = None if setup.reads_elsewhere else setup.options.input
        wire = exchange_time(profile, setup.options.output, own, one_transaction=one_transaction)
        if setup.measure is not None:
            measure = self.session.read_time(profile, setup.measure)
            wire = wire.then(measure.named("to measure the output"))
        return setup.after_reading(wire)

    def rates(self, block: int) -> RateLimit:
        """Return the rates with the present number of transactions."""
        return self.setup.rates(self._time(self._one_transaction).then(self.setup.feed_time))

    def start(self, reader: SensorReader, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.start`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        if not self.setup.reads_elsewhere:
            reader.read()  # a missing address must show before the output moves
        swap, self._one_transaction = self._find_swap(reader)
        self._try_out_safe_value()
        rates = self.rates(block)
        how = "one transaction" if self._one_transaction else "a read and a write"
        replace(rates, note=f"{how} a sample; {rates.note}").check(sample_rate_hz)
        self._swap = self._checked(swap)
        self.requests = self._count_requests()

    def _count_requests(self) -> int:
        """Return the number of requests of a sample."""
        setup, count = self.setup, 1 if self._one_transaction else 2
        if isinstance(setup.input, ModbusInput):
            reader = cast(ModbusProfile, setup.reader.profile)
            count += len(read_requests(reader, setup.input)) - 1
        if setup.measure is not None:
            count += len(read_requests(self._profile, setup.measure))
        return count + (self._profile.error_register != "none")

    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.exchange`."""
        gain, offset, um_per_unit, offset_um = self._factors
        request = self._encode((command.item() - offset) / gain)
        displacement_um[0] = self._swap(request) * um_per_unit + offset_um

    def release(self) -> None:
        """Close the link and forget whether the device exchanges in one transaction."""
        self._one_transaction = self._may_combine
        super().release()

    def _find_swap(self, reader: SensorReader) -> tuple[Swap, bool]:
        """Return the exchange of a sample, and whether it is one transaction.

        The test of one transaction writes the present output again.
        """
        session = self.session
        swap = self._combined()
        held = None if swap is None else session.held_data(self._target)
        if swap is not None and held is not None:
            try:
                swap(held)
                return swap, True
            except NoAnswerError:  # some devices do not answer to an unknown function
                self.link.open()
            except RefusedError:
                pass
        write = session.prepare(write_request(self._profile, self._target))

        def pair(data: bytes) -> float:
            found = reader.read()
            write(data)
            return found

        return pair, False

    def _checked(self, swap: Swap) -> Swap:
        """Return ``swap`` followed by a check of the error register, if there is one."""
        check = self.session.error_check()
        if check is None:
            return swap
        check()  # a refused init step, or an earlier error that only an init step clears

        def checked(data: bytes) -> float:
            found = swap(data)
            check()
            return found

        return checked

    def _combined(self) -> Swap | None:
        setup, session = self.setup, self.session
        if setup.reads_elsewhere or not isinstance(setup.input, ModbusInput):
            return None
        pdu = combined_request(self._profile, self._target, setup.input)
        if pdu is None:
            return None
        call, decode = session.prepare(pdu), session.decoder(setup.input)
        return lambda data: decode(call(data))

    def read(self) -> float | None:
        """See :meth:`~hilctl_drivers.wire.Wire.read`."""
        return self.session.held(self._target)

    def look(self, reader: SensorReader) -> tuple[float, float | None]:
        """See :meth:`~hilctl_drivers.wire.Wire.look`; values show a wrong order of bytes."""
        options = self.setup.options
        reading, held = reader.read(), self.read()
        for name, value in ((options.input, reading), (options.output, held)):
            if value and abs(value) < np.finfo(np.float32).tiny:
                raise DeviceError(
                    f"{name} must be 0 or a normal number, got {value:.3g}: compare its order "
                    "(ABCD, CDAB, ...) and type in the profile with the device's manual"
                )
        if held is None or self.watchdog.tripped():
            return reading, None  # the register keeps the last command
        return reading, held

    def message(self, value: float) -> bytes:
        """See :meth:`~hilctl_drivers.wire.Wire.message`."""
        pdu = write_request(self._profile, self._target, self._encode(value))
        return rtu_adu(self.session.unit, pdu)

    def confirm(self, value: float) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.confirm`."""
        output, data = self._target, self._encode(value)
        self.watchdog.write_through(lambda: self._write(data))
        if self.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self.unconfirmed}")
        found = self._read_back()
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def _try_out_safe_value(self) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self._target
        data = self.session.held_data(output)
        if data is not None:
            name = f"{self.setup.options.output}, register {output.address}"
            try_out(output, output.format.decode(data), lambda: self._write(data), f"to {name}")

    def _write(self, data: bytes) -> None:
        """Write the output's register bytes once."""
        self.session.write_bytes(self._target, data)

    def _read_back(self) -> float | None:
        """Return the value of the output after a safe value; None if unknown."""
        return self.read()
