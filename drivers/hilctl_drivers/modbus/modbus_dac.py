"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile describes the registers, the experiment their wiring. A tick is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device, of any protocol, may have the input. No request is repeated, and none precedes the
last reply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, TypeAlias

import numpy as np

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import SensorReader
from hilctl_drivers.device import DacDevice
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.modbus.config import ModbusOptions, ModbusSetup, session_at
from hilctl_drivers.modbus.modbus_profile import ModbusInput
from hilctl_drivers.modbus.modbus_session import ModbusSession, combined_request, write_request
from hilctl_drivers.modbus.watchdog import ModbusWatchdogDriver
from hilctl_drivers.transport.links import NoAnswerError, RefusedError
from hilctl_drivers.transport.safe_exchange import SafeExchange, check_read_back, try_out
from hilctl_drivers.transport.stream_link import StreamLink

Swap: TypeAlias = Callable[[bytes], float]
"""Write register bytes to the output and return the value of the input in its unit.

The input is read first, so it does not show the new output yet. Function 23 is an exception: the
specification lets the device write first.
"""


Connect: TypeAlias = Callable[[Endpoint], ModbusSession]
"""Makes a session on a new link."""


class ModbusDevice(DacDevice):
    """Session, watchdog and safe value of ``modbus_dac`` and ``modbus_stream``."""

    def __init__(self, setup: ModbusSetup, info: DeviceInfo, action: str, connect: Connect) -> None:
        writer = setup.writer
        title = f"{info.name} {writer.name} at {writer.place}"
        super().__init__(info, title, action, setup.options.output)
        self._setup = setup
        self._connect = connect
        self._peer = writer
        self._guard = ModbusWatchdogDriver(setup)
        self._safe_exchange = SafeExchange()
        self._safe_session: ModbusSession | None = None
        self._writer: ModbusSession | None = None
        self._reader: SensorReader | None = None

    def _sessions(self) -> tuple[ModbusSession, SensorReader]:
        """Connect and check that the devices are the right ones."""
        # Kept before they are opened: after a step that fails, _release must find them.
        self._writer = writer = self._connect(self._setup.writer)
        self._reader = reader = self._setup.reader_on(writer.link)
        writer.link.open()
        self._peer = self._setup.writer.reached(writer.link)
        writer.check_selftest()
        reader.open()
        return writer, reader

    def _connected(self) -> tuple[ModbusSession, SensorReader]:
        """Connect, check that the devices are the right ones, and end a trip."""
        writer, reader = self._sessions()
        # A device that has tripped refuses the steps that follow.
        self._guard.end_trip(writer)
        return writer, reader

    def _arm(self) -> None:
        assert self._writer is not None
        self._guard.arm(self._writer)

    def _output(self) -> float | None:
        assert self._writer is not None
        held = self._writer.held(self._setup.output)
        return None if held is None else self._setup.chain.command(held)

    def _look(self) -> tuple[float, float | None]:
        setup = self._setup
        writer, reader = self._sessions()
        reading, held = reader.read(), writer.held(setup.output)
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

    def _put_out(self, command: float) -> None:
        value, opened = self._setup.chain.output(command), self._writer or self._safe_session
        if opened is not None and not isinstance(opened.link, StreamLink):
            # Many devices take one connection only. The reader is closed afterwards: the port of a
            # sensor that hangs can take its time.
            opened.link.close()
            opened = None
        session = opened or self._connect(self._peer)
        link = session.link
        try:
            # No self-test, no init steps, no reader: none of them may cost the safe value.
            if isinstance(link, StreamLink):
                self._safe_session = session  # it knows whether answers are outstanding
                data = self._setup.output.format.encode(value)
                write = session.prepare(write_request(session.profile, self._setup.output, data))
                self._safe_exchange.attempt(
                    link,
                    lambda: link.send_now(write.request()),
                    lambda: self._confirm(session, value),
                )
            else:
                # A new connection: no answer to an older command can come on it.
                link.open()
                self._confirm(session, value)
        finally:
            link.close()

    def _confirm(self, session: ModbusSession, value: float) -> None:
        """Write ``value``, in the output's unit; raise unless the device confirms it."""
        output = self._setup.output
        data = output.format.encode(value)
        self._guard.write_through(session, lambda: self._write(session, data))
        if self._setup.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self._setup.unconfirmed}")
        found = self._held(session)
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def _try_out_safe_value(self, session: ModbusSession) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self._setup.output
        data = session.held_data(output)
        if data is not None:
            name = f"{self._setup.options.output}, register {output.address}"
            value = output.format.decode(data)
            try_out(output, value, lambda: self._write(session, data), f"to {name}")

    def _write(self, session: ModbusSession, data: bytes) -> None:
        """Write the output's register bytes once."""
        session.write_bytes(self._setup.output, data)

    def _held(self, session: ModbusSession) -> float | None:
        """Return the content of the output's register; None if it cannot be read."""
        return session.held(self._setup.output)

    def _close(self) -> None:
        if self._writer is not None and self._reader is not None:
            # First: nothing feeds it any more, and it would trip while the close steps run.
            self._guard.disarm(self._writer)
            self._writer.run(self._writer.profile.close)
            self._reader.end()

    def _release(self) -> None:
        writer, reader = self._writer, self._reader
        self._writer = self._reader = None
        if writer is not None:
            writer.link.close()
        if reader is not None:
            reader.release()


class ModbusDac(ModbusDevice):
    """A :class:`~hilctl.base.device.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    def __init__(self, options: ModbusOptions, connect: Connect = session_at) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile cannot be used, or the options do not fit it.
        """
        setup = ModbusSetup.of(options)
        action = f"write {options.output}, read {options.input}"
        info = setup.described("modbus_dac", setup.sample_rates(setup.may_combine))
        super().__init__(setup, info, action, connect)
        self._factors = setup.chain.factors
        self._encode = setup.output.format.encode
        self._swap: Swap = _not_open
        self._measure: Callable[[], float] | None = None
        if setup.measure is not None:
            self._measured_by = setup.chain.measured(setup.measure)
        self.one_transaction = False
        """Whether a tick is one transaction; known after opening."""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, one reading of the input; see :class:`DacDevice`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        del block
        self._guard.plan(sample_rate_hz)
        writer, reader = self._connected()
        writer.run(writer.profile.init)
        reader.begin()
        if not self._setup.reads_elsewhere:
            reader.read()  # a missing address must show before the output moves
        swap, self.one_transaction = self._find_swap(writer, reader)
        self._try_out_safe_value(writer)
        rates = self._setup.sample_rates(self.one_transaction)
        how = "one transaction" if self.one_transaction else "a read and a write"
        replace(rates, note=f"{how} a sample; {rates.note}").check(sample_rate_hz)
        self._swap = self._checked(swap, writer)
        if self._setup.measure is not None:
            self._measure = writer.input_reader(self._setup.measure)
        self.transactions = self._setup.transactions(self.one_transaction)

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        gain, offset, um_per_unit, offset_um = self._factors
        request = self._encode((command.item() - offset) / gain)
        displacement_um[0] = self._swap(request) * um_per_unit + offset_um
        if self._measure is not None:
            gain, offset = self._measured_by
            measured[0] = self._measure() * gain + offset
        if self._guard.feed_every and self._writer is not None:
            self._guard.feed(self._writer)

    def _abandon(self) -> None:
        """Keep a serial port, where opening it anew could reset a board before it is safe.

        The reader is kept too: the safe value must not wait until its port is closed.
        """
        link = None if self._writer is None else self._writer.link
        if isinstance(link, StreamLink):
            link.doubt()
        elif link is not None:
            link.close()

    def _release(self) -> None:
        self._swap = _not_open
        super()._release()

    def _find_swap(self, writer: ModbusSession, reader: SensorReader) -> tuple[Swap, bool]:
        """Return how a sample is exchanged, and whether that is one transaction.

        One transaction is tried by writing what the output holds already.
        """
        swap = self._combined(writer)
        held = None if swap is None else writer.held_data(self._setup.output)
        if swap is not None and held is not None:
            try:
                swap(held)
                return swap, True
            except NoAnswerError:  # some devices do not answer to an unknown function
                writer.link.open()
            except RefusedError:
                pass
        write = writer.prepare(write_request(writer.profile, self._setup.output))

        def pair(data: bytes) -> float:
            found = reader.read()
            writer.call(write, data)
            return found

        return pair, False

    def _checked(self, swap: Swap, writer: ModbusSession) -> Swap:
        """Return ``swap`` with a look at the error register, if there is one, after the write."""
        check = writer.error_check()
        if check is None:
            return swap
        check()  # a refused init step, or an error of before

        def checked(data: bytes) -> float:
            found = swap(data)
            check()
            return found

        return checked

    def _combined(self, writer: ModbusSession) -> Swap | None:
        setup = self._setup
        if setup.reads_elsewhere or not isinstance(setup.input, ModbusInput):
            return None
        pdu = combined_request(writer.profile, setup.output, setup.input)
        if pdu is None:
            return None
        transaction, decode = writer.prepare(pdu), writer.decoder(setup.input)
        transact, usual = writer.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: decode(reply(transact(request(data), missing, usual)))


def _not_open(data: bytes) -> float:
    raise DeviceError("not open")
