"""One attempt to write the safe value to a Modbus device, confirmed by reading it back."""

from collections.abc import Callable
from typing import TypeAlias

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.modbus.config import ModbusEndpoint, ModbusSetup
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.watchdog import ModbusWatchdogDriver
from hilctl_drivers.transport.safe_exchange import SafeExchange
from hilctl_drivers.transport.serial_port import SerialLink

Connect: TypeAlias = Callable[[ModbusEndpoint], ModbusSession]
"""Makes a session on a new link."""


class ModbusSafeWrite:
    """Writes the output of a device, one attempt a call.

    Args:
        setup: What the experiment says of the device.
        connect: Makes a session on a new link.
    """

    def __init__(self, setup: ModbusSetup, connect: Connect) -> None:
        self._setup = setup
        self._connect = connect
        self._guard = ModbusWatchdogDriver(setup)
        self._exchange = SafeExchange()
        self._session: ModbusSession | None = None

    def attempt(
        self, peer: ModbusEndpoint, value: float, opened: ModbusSession | None = None
    ) -> None:
        """Write the output and have the device confirm it; the link is closed afterwards.

        Args:
            peer: The device; best with an address that no name server must be asked for.
            value: In the output's unit.
            opened: A session on an open serial line; None to open a connection.

        Raises:
            UnconfirmedError: It was written; the device has no way to confirm it.
            DeviceError: It was not confirmed.
        """
        if opened is None and self._session is not None:
            opened = self._session  # which knows whether answers are outstanding on the line
        session = opened or self._connect(peer)
        link = session.link
        try:
            # No self-test, no init steps, no reader: none of them may cost the safe value.
            if isinstance(link, SerialLink):
                self._session = session
                self._exchange.attempt(
                    link,
                    lambda: link.send_now(self._frame(session, value)),
                    lambda: self._write(session, value),
                )
            else:
                # A new connection: no answer to an older command can come on it.
                link.open()
                self._write(session, value)
        finally:
            link.close()

    def try_out(self, session: ModbusSession) -> None:
        """Write what the output holds, with the message that writes the safe value.

        Nothing moves. An output that cannot be read, or is out of range, is left alone.

        Raises:
            DeviceError: The device refuses the message, or does not answer.
        """
        output, register = self._setup.output, self._setup.output.readback_register
        if register is None:
            return
        data = session.read_bytes(register)
        value = register.format.decode(data)
        if not output.min <= value <= output.max:
            return
        if register.format != output.format:
            data = output.format.encode(value)
        try:
            self._put(session, data)
        except DeviceError as error:
            name = f"{self._setup.options.output}, register {output.address}"
            raise DeviceError(f"the safe value cannot be written to {name}: {error}") from None

    def _frame(self, session: ModbusSession, value: float) -> bytes:
        """Return the request that writes the output."""
        output = self._setup.output
        pdu = session.output_pdu(output, output.format.encode(value))
        return session.prepare(pdu).request()

    def _write(self, session: ModbusSession, value: float) -> None:
        data = self._setup.output.format.encode(value)
        self._guard.write_through(session, lambda: self._put(session, data))
        if self._setup.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self._setup.unconfirmed}")
        self._check_held(session, value)

    def _put(self, session: ModbusSession, data: bytes) -> None:
        """Write the output's register bytes once."""
        session.put_out(self._setup.output, data)

    def _check_held(self, session: ModbusSession, value: float) -> None:
        """Raise unless the output holds the value, if it can be read back."""
        found = session.held(self._setup.output)
        if found is not None:
            self._check(found, value)

    def _check(self, found: float, value: float) -> None:
        output = self._setup.output
        if not abs(found - value) <= max(output.step, 1e-6 * (output.max - output.min)):
            raise DeviceError(f"{value:g} {output.unit} was written, but {found:g} was read back")
