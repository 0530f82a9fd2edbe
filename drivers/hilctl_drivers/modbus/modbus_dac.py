"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile says what the registers mean, the experiment what they are wired to. A tick is one
transaction where the device can read and write in one (function 23, or 76 on LabJack's), else a
read and then a write; the read may go to another device. Nothing is sent twice, and nothing before
the last reply has come.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, TypeAlias

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.device import DacDevice
from hilctl_drivers.modbus.config import ModbusEndpoint, ModbusOptions, ModbusSetup
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import feedback_pdu, read_pdu, write_read_pdu
from hilctl_drivers.modbus.watchdog import Connect, ModbusSafeWrite, ModbusWatchdogDriver
from hilctl_drivers.transport.links import NoAnswerError, RefusedError, naming
from hilctl_drivers.transport.serial_port import SerialLink

Swap: TypeAlias = Callable[[bytes], bytes]
"""Write these register bytes to the output, return those of the input.

The input is read first, so that it does not show yet what is written. Function 23 has an order of
its own: the specification lets the device write first.
"""


class ModbusDac(DacDevice):
    """A :class:`~hilctl.base.device.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    def __init__(
        self,
        options: ModbusOptions,
        connect: Connect = ModbusEndpoint.session,
    ) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Args:
            options: What the experiment says of it.
            connect: Makes a session on a new link to the device that has the output.

        Raises:
            InputError: The profile cannot be used, or options do not go with it.
        """
        setup = ModbusSetup.of(options)
        super().__init__(
            setup.info(),
            f"modbus_dac {setup.writer.name} at {setup.writer.place}",
            f"write {options.output}, read {options.input}",
            options.output,
        )
        self._setup = setup
        self._connect = connect
        self._peer = setup.writer
        self._safe_write = ModbusSafeWrite(setup, connect)
        self._factors = setup.chain.factors
        self._encode = setup.output.format.encode
        self._decode = setup.input.format.decode
        self._guard = ModbusWatchdogDriver(setup)
        self._pair: ModbusPair | None = None
        self._swap: Swap = _not_open
        self._feeds = False
        self.one_transaction = False
        """Whether a tick is one transaction; known after opening."""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, one reading of the input; see :class:`DacDevice`.

        Whether it can read and write in one transaction, and whether it takes the message of the
        safe value, is tried by writing what the output holds already. Only then is it known what
        rate it can keep.
        """
        del block
        self._guard.plan(sample_rate_hz)
        # Kept before it is opened: after a step that fails, _release must find it.
        self._pair = pair = ModbusPair(self._setup, self._connect(self._setup.writer))
        pair.open()
        self._peer = self._setup.writer.reached(pair.writer.link)
        # A device that has tripped refuses the steps that follow.
        self._guard.end_trip(pair.writer)
        pair.set_up()
        swap, self.one_transaction = pair.find_swap()
        self._safe_write.try_out(pair.writer)
        rates = self._setup.rates(self.one_transaction)
        how = "one transaction" if self.one_transaction else "a read and a write"
        replace(rates, note=f"{how} a sample; {rates.note}").check(sample_rate_hz)
        self._feeds = self._guard.feed_every > 0
        self._swap = swap

    def _arm(self) -> None:
        assert self._pair is not None
        self._guard.arm(self._pair.writer)

    def _output(self) -> float | None:
        assert self._pair is not None
        held = self._pair.writer.held(self._setup.output)
        return None if held is None else self._setup.chain.command(held)

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        gain, offset, um_per_unit, offset_um = self._factors
        request = self._encode((command.item() - offset) / gain)
        data = self._swap(request)
        displacement_um[0] = self._decode(data) * um_per_unit + offset_um
        if self._feeds and self._pair is not None:
            self._guard.feed(self._pair.writer)

    def _put_out(self, command: float) -> None:
        value = self._setup.chain.output(command)
        opened = self._pair.writer if self._pair is not None else None
        if opened is not None and not isinstance(opened.link, SerialLink):
            self._release()  # many devices take one connection only
            opened = None
        self._safe_write.attempt(self._peer, value, opened)

    def _abandon(self) -> None:
        """Keep a serial port, where opening it anew could reset a board before it is safe."""
        link = None if self._pair is None else self._pair.writer.link
        if isinstance(link, SerialLink):
            link.doubt()
        else:
            self._release()

    def _look(self) -> tuple[float, float | None]:
        return ModbusPair(self._setup, self._setup.writer.session()).look()

    def _close(self) -> None:
        if self._pair is not None:
            # First: nothing feeds it any more, and it would trip while the close steps run.
            self._guard.disarm(self._pair.writer)
            self._pair.tear_down()

    def _release(self) -> None:
        pair, self._pair, self._swap = self._pair, None, _not_open
        if pair is not None:
            pair.release()


def _not_open(data: bytes) -> bytes:
    raise DeviceError("not open")


class ModbusPair:
    """Two sessions, or one of them twice; nothing is sent before :meth:`open`.

    Args:
        setup: What the experiment says of the device.
        writer: Session with the device that has the output.
    """

    def __init__(self, setup: ModbusSetup, writer: ModbusSession) -> None:
        self._setup = setup
        self.writer = writer
        self.reader = self.writer
        self._one = not setup.reads_elsewhere
        self._reader = ""
        if not self._one:
            other = setup.reader
            self._reader = f"reader {other.name}, unit {other.unit} at {other.place}"
            self.reader = setup.reader.session(self.writer.link if setup.shares_link else None)

    def open(self) -> None:
        """Connect and run the self-tests.

        Raises:
            DeviceError: A device cannot be reached, or is another one.
        """
        self.writer.link.open()
        self.writer.check_selftest()
        if self._one:
            return
        with naming(self._reader):
            if self.reader.link is not self.writer.link:
                self.reader.link.open()
            self.reader.check_selftest()

    def set_up(self) -> None:
        """Run the init steps of the profiles.

        Raises:
            DeviceError: A step failed.
        """
        self.writer.run(self.writer.profile.init)
        if not self._one:
            with naming(self._reader):
                self.reader.run(self.reader.profile.init)

    def tear_down(self) -> None:
        """Run the close steps of the profiles.

        Raises:
            DeviceError: A step failed.
        """
        self.writer.run(self.writer.profile.close)
        if not self._one:
            with naming(self._reader):
                self.reader.run(self.reader.profile.close)

    def look(self) -> tuple[float, float | None]:
        """Connect, read input and output register, and close the links; nothing is changed.

        Returns:
            Displacement in um, and the output in the command's unit; None if it cannot be read, or
            the register holds a command from before a trip of the watchdog.

        Raises:
            DeviceError: A device cannot be reached, is another one, or gives no good answer.
        """
        setup, writer = self._setup, self.writer
        try:
            self.open()
            with naming(self._reader):
                found = setup.input.format.decode(self.reader.read_bytes(setup.input))
            watchdog = writer.profile.watchdog
            flag = "none" if watchdog == "none" else watchdog.tripped
            # A trip leaves the last command in the register.
            knows = setup.output.readback_register is not None
            held = None
            if knows and (flag == "none" or not writer.is_set(flag)):
                held = writer.held(setup.output)
        finally:
            self.release()
        output = None if held is None else setup.chain.command(held)
        return setup.chain.displacement_um(found), output

    def release(self) -> None:
        """Close the links."""
        self.writer.link.close()
        self.reader.link.close()

    def find_swap(self) -> tuple[Swap, bool]:
        """Return how a sample is exchanged, and whether that is one transaction.

        The input is read once before: an address that the device does not have must not show only
        when the output has begun to move. One transaction is tried by writing what the output holds
        already.

        Raises:
            DeviceError: The input or the output cannot be read.
        """
        with naming(self._reader):
            self.reader.read_bytes(self._setup.input)
        swap = self._combined()
        readback = self._setup.output.readback_register
        if swap is None or readback is None:
            return self._one_after_the_other(), False
        held = self.writer.read_bytes(readback)  # who is silent here is not there at all
        try:
            swap(held)
        except RefusedError:
            return self._one_after_the_other(), False
        except NoAnswerError:  # some devices are silent about functions they don't know
            self.writer.link.open()
            return self._one_after_the_other(), False
        return swap, True

    def _one_after_the_other(self) -> Swap:
        setup, source = self._setup, self._setup.input
        writer, reader = self.writer, self.reader
        write = writer.prepare(writer.output_pdu(setup.output, bytes(2 * setup.output.words)))
        address = setup.reader.address(source)
        read = reader.prepare(read_pdu(source.read_function, address, source.words))

        def pair(data: bytes) -> bytes:
            found = reader.call(read)
            writer.call(write, data)
            return found

        def named_pair(data: bytes) -> bytes:
            with naming(self._reader):
                found = reader.call(read)
            writer.call(write, data)
            return found

        return pair if self._one else named_pair

    def _combined(self) -> Swap | None:
        setup = self._setup
        kind = setup.writer.profile.exchange
        if kind == "none" or not self._one:
            return None
        source, target = setup.reader.address(setup.input), setup.writer.address(setup.output)
        words, data = setup.input.words, bytes(2 * setup.output.words)
        if kind == 23:
            pdu = write_read_pdu(source, words, target, data)
        else:
            pdu = feedback_pdu(target, data, source, words)
        transaction = self.writer.prepare(pdu)
        transact, usual = self.writer.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: reply(transact(request(data), missing, usual))
