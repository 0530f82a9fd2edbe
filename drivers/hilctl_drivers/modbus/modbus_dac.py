"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile describes the registers, the experiment their wiring. A tick is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device may have the input. No request is repeated, and none precedes the last reply.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal, TypeAlias

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.device import DacDevice
from hilctl_drivers.modbus.config import ModbusEndpoint, ModbusOptions, ModbusSetup
from hilctl_drivers.modbus.modbus_session import (
    ModbusSession,
    combined_request,
    read_request,
    write_request,
)
from hilctl_drivers.modbus.watchdog import Connect, ModbusSafeWrite, ModbusWatchdogDriver
from hilctl_drivers.transport.links import NoAnswerError, RefusedError, naming
from hilctl_drivers.transport.serial_port import SerialLink

Swap: TypeAlias = Callable[[bytes], bytes]
"""Write register bytes to the output and return those of the input.

The input is read first, so it does not show the new output yet. Function 23 is an exception: the
specification lets the device write first.
"""


class ModbusDevice(DacDevice):
    """Session, watchdog and safe value of ``modbus_dac`` and ``modbus_stream``."""

    def __init__(
        self,
        setup: ModbusSetup,
        info: DeviceInfo,
        action: str,
        safe_write: ModbusSafeWrite,
        connect: Connect,
    ) -> None:
        writer = setup.writer
        title = f"{info.name} {writer.name} at {writer.place}"
        super().__init__(info, title, action, setup.options.output)
        self._setup = setup
        self._connect = connect
        self._peer = writer
        self._safe_write = safe_write
        self._guard = ModbusWatchdogDriver(setup)
        self._pair: ModbusPair | None = None

    def _connected(self) -> "ModbusPair":
        """Connect, check that the devices are the right ones, and end a trip."""
        # Kept before it is opened: after a step that fails, _release must find it.
        self._pair = pair = ModbusPair(self._setup, self._connect(self._setup.writer))
        pair.open()
        self._peer = self._setup.writer.reached(pair.writer.link)
        # A device that has tripped refuses the steps that follow.
        self._guard.end_trip(pair.writer)
        return pair

    def _arm(self) -> None:
        assert self._pair is not None
        self._guard.arm(self._pair.writer)

    def _output(self) -> float | None:
        assert self._pair is not None
        held = self._pair.writer.held(self._setup.output)
        return None if held is None else self._setup.chain.command(held)

    def _look(self) -> tuple[float, float | None]:
        return ModbusPair(self._setup, self._setup.writer.session()).look()

    def _close(self) -> None:
        if self._pair is not None:
            # First: nothing feeds it any more, and it would trip while the close steps run.
            self._guard.disarm(self._pair.writer)
            self._pair.run("close")

    def _release(self) -> None:
        pair, self._pair = self._pair, None
        if pair is not None:
            pair.release()


class ModbusDac(ModbusDevice):
    """A :class:`~hilctl.base.device.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    def __init__(self, options: ModbusOptions, connect: Connect = ModbusEndpoint.session) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile cannot be used, or the options do not fit it.
        """
        setup = ModbusSetup.of(options)
        action = f"write {options.output}, read {options.input}"
        super().__init__(setup, setup.info(), action, ModbusSafeWrite(setup, connect), connect)
        self._factors = setup.chain.factors
        self._encode = setup.output.format.encode
        self._decode = setup.input.format.decode
        self._swap: Swap = _not_open
        self.one_transaction = False
        """Whether a tick is one transaction; known after opening."""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, one reading of the input; see :class:`DacDevice`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        del block
        self._guard.plan(sample_rate_hz)
        pair = self._connected()
        pair.run("init")
        swap, self.one_transaction = pair.find_swap()
        self._safe_write.try_out(pair.writer)
        rates = self._setup.rates(self.one_transaction)
        how = "one transaction" if self.one_transaction else "a read and a write"
        replace(rates, note=f"{how} a sample; {rates.note}").check(sample_rate_hz)
        self._swap = swap

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        gain, offset, um_per_unit, offset_um = self._factors
        request = self._encode((command.item() - offset) / gain)
        data = self._swap(request)
        displacement_um[0] = self._decode(data) * um_per_unit + offset_um
        if self._guard.feed_every and self._pair is not None:
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

    def _release(self) -> None:
        self._swap = _not_open
        super()._release()


def _not_open(data: bytes) -> bytes:
    raise DeviceError("not open")


class ModbusPair:
    """Sessions with the device that has the output and the one that has the input, often the same.

    Errors of the latter name it. Nothing is sent before :meth:`open`.
    """

    def __init__(self, setup: ModbusSetup, writer: ModbusSession) -> None:
        self._setup = setup
        self.writer = self.reader = writer
        self._reader = ""
        self._sessions = [("", writer)]
        if setup.reads_elsewhere:
            other = setup.reader
            self._reader = f"reader {other.name}, unit {other.unit} at {other.place}"
            self.reader = other.session(writer.link if setup.shares_link else None)
            self._sessions.append((self._reader, self.reader))

    def open(self) -> None:
        """Connect and run the self-tests."""
        opened = None
        for name, session in self._sessions:
            with naming(name):
                if session.link is not opened:
                    session.link.open()
                opened = session.link
                session.check_selftest()

    def run(self, steps: Literal["init", "close"]) -> None:
        """Run these steps of the profiles."""
        for name, session in self._sessions:
            with naming(name):
                session.run(getattr(session.profile, steps))

    def look(self) -> tuple[float, float | None]:
        """Connect, read input and output register, and close the links; nothing is changed.

        Returns:
            Displacement in um, and the output in the command's unit; None if it cannot be read, or
            the register holds a command from before a trip of the watchdog.
        """
        setup, writer = self._setup, self.writer
        try:
            self.open()
            with naming(self._reader):
                found = setup.input.format.decode(self.reader.read_bytes(setup.input))
            held = writer.held(setup.output)
            watchdog = writer.profile.watchdog
            flag = "none" if watchdog == "none" else watchdog.tripped
            if held is not None and flag != "none" and writer.is_set(flag):
                held = None  # the register keeps the last command
        finally:
            self.release()
        output = None if held is None else setup.chain.command(held)
        return setup.chain.displacement_um(found), output

    def release(self) -> None:
        """Close the links."""
        for _, session in self._sessions:
            session.link.close()

    def find_swap(self) -> tuple[Swap, bool]:
        """Return how a sample is exchanged, and whether that is one transaction.

        The input is read once before: a missing address must show before the output moves. One
        transaction is tried by writing what the output holds already.
        """
        with naming(self._reader):
            self.reader.read_bytes(self._setup.input)
        swap = self._combined()
        readback = self._setup.output.readback_register
        if swap is not None and readback is not None:
            held = self.writer.read_bytes(readback)  # no answer here: there is no device
            try:
                swap(held)
                return swap, True
            except NoAnswerError:  # some devices do not answer to an unknown function
                self.writer.link.open()
            except RefusedError:
                pass
        return self._one_after_the_other(), False

    def _one_after_the_other(self) -> Swap:
        setup, writer, reader = self._setup, self.writer, self.reader
        write = writer.prepare(write_request(writer.profile, setup.output))
        read = reader.prepare(read_request(reader.profile, setup.input))

        def pair(data: bytes) -> bytes:
            with naming(self._reader):
                found = reader.call(read)
            writer.call(write, data)
            return found

        return pair

    def _combined(self) -> Swap | None:
        setup = self._setup
        if setup.reads_elsewhere:
            return None
        pdu = combined_request(self.writer.profile, setup.output, setup.input)
        if pdu is None:
            return None
        transaction = self.writer.prepare(pdu)
        transact, usual = self.writer.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: reply(transact(request(data), missing, usual))
