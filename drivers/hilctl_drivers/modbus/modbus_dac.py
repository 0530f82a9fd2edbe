"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile describes the registers, the experiment their wiring. A tick is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device, of any protocol, may have the input. No request is repeated, and none precedes the
last reply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, TypeAlias, cast

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.modbus.modbus_device import ModbusDevice
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import combined_request, read_requests, write_request
from hilctl_drivers.signal_chain import DacOptions, Measure
from hilctl_drivers.transport.links import NoAnswerError, RefusedError
from hilctl_drivers.transport.wire_time import RateLimit

Swap: TypeAlias = Callable[[bytes], float]
"""Write register bytes to the output and return the value of the input in its unit.

The input is read first, so it does not show the new output yet. Function 23 is an exception: the
specification lets the device write first.
"""


class ModbusOptions(DacOptions):
    """Options of ``modbus_dac``."""

    measure: Measure = None


class ModbusDac(ModbusDevice):
    """A :class:`~hilctl.base.device.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    KIND = "modbus_dac"

    def _prepare(self) -> None:
        super()._prepare()
        self._factors = self._chain.factors
        self._encode = self._target.format.encode
        self._swap: Swap = _not_open
        self.one_transaction = self._may_combine
        """Whether a tick is one transaction, as far as is known; opening it shows."""

    def _rates(self, block: int) -> RateLimit:
        """Return the rates with the present number of transactions."""
        return self._setup.rates(self._wire(self.one_transaction).then(self._feed_time()))

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, one reading of the input; see :class:`DacDevice`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        writer = self._writer
        self._plan_feeding(sample_rate_hz)
        self._connect()
        self._end_trip()  # a device that has tripped refuses the steps that follow
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
            self._measure_output(measured)
        if self._feed_every:
            self._feed()

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
            write(data)
            return found

        return pair, False

    def _checked(self, swap: Swap) -> Swap:
        """Return ``swap`` with a look at the error register, if there is one, after the write."""
        check = self._writer.error_check()
        if check is None:
            return swap
        check()  # a refused init step, or an error of before that only an init step clears

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
        call, decode = writer.prepare(pdu), writer.decoder(setup.input)
        return lambda data: decode(call(data))


def _not_open(data: bytes) -> float:
    raise DeviceError("not open")
