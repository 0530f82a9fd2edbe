"""The device that has the output and the one that has the input: often the same, sometimes not."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_pdu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.wire.errors import Refused
from hilctl_drivers.wire.links import NoAnswerError

Swap: TypeAlias = Callable[[bytes], bytes]
"""Write these register bytes to the output, return those of the input.

The input is read first, so that it does not show yet what is written. Function 23 has an order of
its own: the specification lets the device write first.
"""


class ModbusPair:
    """Two sessions, or one of them twice; nothing is sent before :meth:`open`.

    Args:
        setup: What the experiment says of the device.
    """

    def __init__(self, setup: ModbusSetup) -> None:
        self._setup = setup
        self.writer = setup.session()
        self.reader = setup.reader_session(self.writer)

    @property
    def _one(self) -> bool:
        return self.reader is self.writer

    def open(self) -> None:
        """Connect and run the self-tests.

        Raises:
            DeviceError: A device can't be reached, or is another one.
        """
        self.writer.link.open()
        self.writer.check_selftest()
        if self._one:
            return
        with self._reader_named():
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
            with self._reader_named():
                self.reader.run(self.reader.profile.init)

    def tear_down(self) -> None:
        """Run the close steps of the profiles.

        Raises:
            DeviceError: A step failed.
        """
        self.writer.run(self.writer.profile.close)
        if not self._one:
            with self._reader_named():
                self.reader.run(self.reader.profile.close)

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
            DeviceError: The input or the output can't be read.
        """
        with self._reader_named():
            self.reader.read_bytes(self._setup.input)
        swap = self._combined()
        readback = self._setup.output.readback_register
        if swap is None or readback is None:
            return self._one_after_the_other(), False
        held = self.writer.read_bytes(readback)  # who is silent here is not there at all
        try:
            swap(held)
        except Refused:
            return self._one_after_the_other(), False
        except NoAnswerError:  # some devices are silent about functions they don't know
            self.writer.link.open()
            return self._one_after_the_other(), False
        return swap, True

    def put_out(self, data: bytes) -> None:
        """Write the output's register bytes.

        Raises:
            DeviceError: The device does not confirm.
        """
        self.writer.call(self.writer.prepare(self._write_pdu(data)))

    def _write_pdu(self, data: bytes) -> bytes:
        output, address = self._setup.output, self._setup.address(self._setup.output)
        return (write_single_pdu if output.function == 6 else write_pdu)(address, data)

    def _one_after_the_other(self) -> Swap:
        setup, source = self._setup, self._setup.input
        writer, reader = self.writer, self.reader
        write = writer.prepare(self._write_pdu(bytes(2 * setup.output.words)))
        address = setup.input_address()
        read = reader.prepare(read_pdu(source.read_function, address, source.words))

        def pair(data: bytes) -> bytes:
            found = reader.call(read)
            writer.call(write, data)
            return found

        def named_pair(data: bytes) -> bytes:
            try:
                found = reader.call(read)
            except DeviceError as error:
                raise self._named(error) from None
            writer.call(write, data)
            return found

        return pair if self._one else named_pair

    def _combined(self) -> Swap | None:
        setup = self._setup
        kind = setup.profile.exchange
        if kind == "none" or not self._one:
            return None
        source, target = setup.input_address(), setup.address(setup.output)
        words, data = setup.input.words, bytes(2 * setup.output.words)
        if kind == 23:
            pdu = write_read_pdu(source, words, target, data)
        else:
            pdu = feedback_pdu(target, data, source, words)
        transaction = self.writer.prepare(pdu)
        transact, usual = self.writer.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: reply(transact(request(data), missing, usual))

    @contextmanager
    def _reader_named(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as error:
            raise self._named(error) from None

    def _named(self, error: DeviceError) -> DeviceError:
        """Return an error that says that the reader made it, where it is another device."""
        return error if self._one else DeviceError(f"{self._setup.reader_title}: {error}")
