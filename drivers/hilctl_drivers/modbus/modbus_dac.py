"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile describes the registers, the experiment their wiring. A tick is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device, of any protocol, may have the input. No request is repeated, and none precedes the
last reply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, TypeAlias, cast

import numpy as np

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import DeviceError, InputError, UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import SensorReader
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import (
    arm_s,
    combined_request,
    exchange_time,
    feed_time,
    read_requests,
    read_time,
    session_at,
    write_request,
)
from hilctl_drivers.modbus.watchdog import ModbusWatchdogDriver
from hilctl_drivers.signal_chain import DacOptions, Measure
from hilctl_drivers.transport.links import Link, NoAnswerError, RefusedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wired_dac import WiredDac

Swap: TypeAlias = Callable[[bytes], float]
"""Write register bytes to the output and return the value of the input in its unit.

The input is read first, so it does not show the new output yet. Function 23 is an exception: the
specification lets the device write first.
"""


class ModbusOptions(DacOptions):
    """Options of ``modbus_dac``."""

    measure: Measure = None


class ModbusDevice(WiredDac):
    """Session, watchdog and safe value of ``modbus_dac`` and ``modbus_stream``."""

    _reader: SensorReader

    def __init__(self, options: DacOptions, link: Link | None = None) -> None:
        """See :class:`~hilctl_drivers.wired_dac.WiredDac`."""
        profile = options.profile.profile
        if not isinstance(profile, ModbusProfile):
            name = options.profile.name
            raise InputError(f"profile {name} is one for kind: {profile.DEVICE}, not Modbus")
        super().__init__(options, link)

    def _prepare(self) -> None:
        setup, options = self._setup, self._options
        self._profile = cast(ModbusProfile, setup.writer.profile)
        self._target = cast(ModbusOutput, setup.output)
        self._writer = session_at(setup.writer, self._link)
        self._reader = setup.reader_on(self._link)
        self._guard = ModbusWatchdogDriver(setup)
        self.measures = setup.measure is not None
        self.arm_s = arm_s(self._profile, options.output)
        readback = self._target.readback_register
        if readback is None and self._target.function == 6 and setup.writer.framing == "rtu":
            # The correct reply equals the request, and is what a line that echoes gives.
            self.unconfirmed = (
                "the device cannot confirm it: on a serial line the reply to function 6 may be an "
                "echo, and the output cannot be read back"
            )
        # One transaction is tried at open. That moves an output that cannot be read back, so it is
        # not tried there.
        self._may_combine = (
            self._profile.exchange != "none" and readback is not None and not setup.reads_elsewhere
        )
        setup.check_timeout(self._wire(self._may_combine))

    def _wire(self, one_transaction: bool) -> WireTime:
        """Return the time of a sample on the wire."""
        setup, profile = self._setup, self._profile
        own = None if setup.reads_elsewhere else setup.options.input
        wire = exchange_time(profile, setup.options.output, own, one_transaction=one_transaction)
        if setup.measure is not None:
            wire = wire.then(read_time(profile, setup.measure).named("to measure the output"))
        return setup.after_reading(wire)

    def _connect(self) -> None:
        """Connect and check that the devices are the right ones."""
        self._link.open()
        self._writer.check_selftest()
        self._reader.open()

    def _arm(self) -> None:
        self._guard.arm(self._writer)

    def _held(self) -> float | None:
        return self._writer.held(self._target)

    def _look(self) -> tuple[float, float | None]:
        setup, writer = self._setup, self._writer
        self._connect()
        reading, held = self._reader.read(), self._held()
        for name, value in ((setup.options.input, reading), (setup.options.output, held)):
            if value and abs(value) < np.finfo(np.float32).tiny:
                raise DeviceError(
                    f"{name} must be 0 or a normal number, got {value:.3g}: compare its order "
                    "(ABCD, CDAB, ...) and type in the profile with the device's manual"
                )
        displacement_um = setup.chain.displacement_um(reading)
        watchdog = writer.profile.watchdog
        flag = "none" if watchdog == "none" else watchdog.tripped
        if held is None or (flag != "none" and writer.is_set(flag)):
            return displacement_um, None  # the register keeps the last command
        return displacement_um, setup.chain.command(held)

    def _send(self, value: float) -> None:
        assert isinstance(self._link, StreamLink)
        output = self._target
        pdu = write_request(self._writer.profile, output, output.format.encode(value))
        self._link.send_now(self._writer.prepare(pdu).request())

    def _confirm(self, value: float) -> None:
        output = self._target
        data = output.format.encode(value)
        self._guard.write_through(self._writer, lambda: self._write(data))
        if self.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self.unconfirmed}")
        found = self._read_back()
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def _try_out_safe_value(self) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self._target
        data = self._writer.held_data(output)
        if data is not None:
            name = f"{self._setup.options.output}, register {output.address}"
            try_out(output, output.format.decode(data), lambda: self._write(data), f"to {name}")

    def _write(self, data: bytes) -> None:
        """Write the output's register bytes once."""
        self._writer.write_bytes(self._target, data)

    def _read_back(self) -> float | None:
        """Return the value of the output after a safe value; None if it cannot be known."""
        return self._held()

    def _close(self) -> None:
        # First: nothing feeds it any more, and it would trip while the close steps run.
        self._guard.disarm(self._writer)
        self._writer.run(self._writer.profile.close)
        self._reader.end()


class ModbusDac(ModbusDevice):
    """A :class:`~hilctl.base.device.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    KIND = "modbus_dac"

    def _prepare(self) -> None:
        super()._prepare()
        self._factors = self._chain.factors
        self._encode = self._target.format.encode
        self._swap: Swap = _not_open
        self._measure: Callable[[], float] | None = None
        if self._setup.measure is not None:
            self._measured_by = self._chain.measured(self._setup.measure)
        self.one_transaction = self._may_combine
        """Whether a tick is one transaction, as far as is known; opening it shows."""

    def _rates(self, block: int) -> RateLimit:
        """Return the rates with the present number of transactions."""
        del block
        wire = self._wire(self.one_transaction)
        if self._options.watchdog != "none":
            wire = wire.then(feed_time(self._profile))
        return self._setup.rates(wire)

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, one reading of the input; see :class:`DacDevice`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        writer = self._writer
        self._guard.plan(sample_rate_hz)
        self._connect()
        self._guard.end_trip(writer)  # a device that has tripped refuses the steps that follow
        writer.run(writer.profile.init)
        self._reader.begin()
        if not self._setup.reads_elsewhere:
            self._reader.read()  # a missing address must show before the output moves
        swap, self.one_transaction = self._find_swap()
        self._try_out_safe_value()
        rates = self._rates(block)
        how = "one transaction" if self.one_transaction else "a read and a write"
        replace(rates, note=f"{how} a sample; {rates.note}").check(sample_rate_hz)
        self._swap = self._checked(swap)
        if self._setup.measure is not None:
            self._measure = writer.input_reader(self._setup.measure)
        self.transactions = self._transactions()

    def _transactions(self) -> int:
        """Return the number of requests of a sample."""
        setup, count = self._setup, 1 if self.one_transaction else 2
        if isinstance(setup.input, ModbusInput):
            reader = cast(ModbusProfile, setup.reader.profile)
            count += len(read_requests(reader, setup.input)) - 1
        if setup.measure is not None:
            count += len(read_requests(self._profile, setup.measure))
        return count + (self._profile.error_register != "none")

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        gain, offset, um_per_unit, offset_um = self._factors
        request = self._encode((command.item() - offset) / gain)
        displacement_um[0] = self._swap(request) * um_per_unit + offset_um
        if self._measure is not None:
            gain, offset = self._measured_by
            measured[0] = self._measure() * gain + offset
        if self._guard.feed_every:
            self._guard.feed(self._writer)

    def _release(self) -> None:
        self._swap, self.one_transaction = _not_open, self._may_combine
        super()._release()

    def _find_swap(self) -> tuple[Swap, bool]:
        """Return how a sample is exchanged, and whether that is one transaction.

        One transaction is tried by writing what the output holds already.
        """
        writer, reader = self._writer, self._reader
        swap = self._combined()
        held = None if swap is None else writer.held_data(self._target)
        if swap is not None and held is not None:
            try:
                swap(held)
                return swap, True
            except NoAnswerError:  # some devices do not answer to an unknown function
                writer.link.open()
            except RefusedError:
                pass
        write = writer.prepare(write_request(writer.profile, self._target))

        def pair(data: bytes) -> float:
            found = reader.read()
            writer.call(write, data)
            return found

        return pair, False

    def _checked(self, swap: Swap) -> Swap:
        """Return ``swap`` with a look at the error register, if there is one, after the write."""
        check = self._writer.error_check()
        if check is None:
            return swap
        check()  # a refused init step, or an error of before

        def checked(data: bytes) -> float:
            found = swap(data)
            check()
            return found

        return checked

    def _combined(self) -> Swap | None:
        setup, writer = self._setup, self._writer
        if setup.reads_elsewhere or not isinstance(setup.input, ModbusInput):
            return None
        pdu = combined_request(writer.profile, self._target, setup.input)
        if pdu is None:
            return None
        transaction, decode = writer.prepare(pdu), writer.decoder(setup.input)
        transact, usual = writer.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: decode(reply(transact(request(data), missing, usual)))


def _not_open(data: bytes) -> float:
    raise DeviceError("not open")
