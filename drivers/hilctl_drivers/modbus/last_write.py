"""The write that makes an output safe: tried until the device confirms it, and until it holds.

A command that was never answered may still be carried out when the safe value stands already: by a
device that takes its connections in turn, or comes back from a pause. So the value is read back
until such a command can't come any more, and written again where it has changed.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.modbus.setup import ModbusPeer, ModbusSetup
from hilctl_drivers.modbus.watchdog import ModbusGuard

Connect: TypeAlias = Callable[[ModbusPeer], ModbusSession]
"""Makes a session on a new link."""

TRIES_S = 5.0
"""How long a device that can't be reached, or does not answer, is tried again."""
ANSWER_S = 0.5
"""A device that has not answered by then gets a new connection, where it should be faster."""
RETRY_S = 0.05
POLL_S = 0.05


class ModbusLastWrite:
    """Writes the output of a device to which no connection is open.

    Args:
        setup: What the experiment says of the device.
        connect: Makes a session on a new link.
        sleep: Waits that many s.
        clock: Monotonic time in s.
    """

    def __init__(
        self,
        setup: ModbusSetup,
        connect: Connect,
        sleep: Callable[[float], None],
        clock: Callable[[], float],
    ) -> None:
        self._setup = setup
        self._connect, self._sleep, self._clock = connect, sleep, clock
        self._guard = ModbusGuard(setup)
        timeout_s = setup.options.timeout_s
        longest_s = max(ANSWER_S, 2.0 * setup.wire(setup.may_combine).answered_s)
        self._answer_s = min(timeout_s, longest_s)
        # Our kernel sends a command again for one time-out; the device has another one for it.
        self._older_s = 2.0 * max(timeout_s, ANSWER_S)

    def put_out(self, peer: ModbusPeer, value: float, *, under_way: bool) -> None:
        """Write the output, and see that it holds.

        Args:
            peer: The device; best with an address that no name server must be asked for.
            value: In the output's unit.
            under_way: Whether an older command may still be carried out.

        Raises:
            DeviceError: It was not confirmed, or did not hold; what is put out is not known.
        """
        hold_s = self._older_s if under_way else 0.0
        give_up_s = self._clock() + TRIES_S + hold_s
        peer = replace(peer, timeout_s=self._answer_s)
        while True:
            try:
                self._attempt(peer, value, hold_s, give_up_s)
            except DeviceError as error:
                if self._clock() >= give_up_s:
                    raise DeviceError(f"{error}; what it puts out is not known") from None
            else:
                return
            self._sleep(RETRY_S)

    def _attempt(self, peer: ModbusPeer, value: float, hold_s: float, give_up_s: float) -> None:
        session = self._connect(peer)
        try:
            # No self-test, no init steps, no reader: none of them may cost the safe value.
            session.link.open()
            self._write(session, value)
            self._watch(session, value, hold_s, give_up_s)
        finally:
            session.link.close()

    def _write(self, session: ModbusSession, value: float) -> None:
        self._guard.write_through(session, lambda: self._put(session, value))

    def _watch(self, session: ModbusSession, value: float, hold_s: float, give_up_s: float) -> None:
        """Read back until the value has stood for ``hold_s``; write it again where it does not."""
        # From now: a device that was silent until now may find older commands beside ours.
        end_s = self._clock() + hold_s
        while True:
            held = self._holds(session, value)
            now_s = self._clock()
            if held and now_s >= end_s:
                return
            if now_s >= give_up_s:
                raise DeviceError("the safe value was written, but was not seen to stay")
            if held:
                self._sleep(min(POLL_S, end_s - now_s))
            else:
                self._write(session, value)
                end_s = self._clock() + hold_s

    def _put(self, session: ModbusSession, value: float) -> None:
        """Write the output once."""
        output = self._setup.output
        session.put_out(output, output.format.encode(value))

    def _holds(self, session: ModbusSession, value: float) -> bool:
        """Return whether the output stands there; one that can't be read is written again."""
        found = session.held(self._setup.output)
        if found is None:
            self._put(session, value)
            return True
        return self._agrees(found, value)

    def _agrees(self, found: float, value: float) -> bool:
        output = self._setup.output
        return abs(found - value) <= max(output.step, 1e-6 * (output.max - output.min))
