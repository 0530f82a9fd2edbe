"""Host watchdog of a Modbus device, and the write of the safe value."""

from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.modbus.config import ModbusSetup
from hilctl_drivers.modbus.modbus_profile import ModbusWatchdog
from hilctl_drivers.modbus.modbus_session import ModbusSession, write_request
from hilctl_drivers.modbus.register_map import ModbusStep, RegisterStep
from hilctl_drivers.transport.links import RefusedError
from hilctl_drivers.transport.safe_exchange import SafeExchange, check_read_back, try_out
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import check_feeds


class ModbusWatchdogDriver:
    """The watchdog, as the experiment wants it."""

    def __init__(self, setup: ModbusSetup) -> None:
        self._setup = setup
        self._wanted = setup.options.watchdog
        self._has = setup.profile.watchdog
        self._ticks = 0
        self.feed_every = 0
        """Ticks from one feeding to the next; 0 if exchanges feed it."""

    def write_through(self, session: ModbusSession, put: Callable[[], None]) -> None:
        """Write the output by ``put``, even if the watchdog has tripped.

        Before the trip is cleared, so that no stale command takes effect then; and after it, for a
        device that refuses or ignores writes until then.
        """
        has = self._has
        if has == "none" or not has.clear:
            put()
            return
        with suppress(RefusedError):
            put()
            if has.tripped == "none" or not session.is_set(has.tripped):
                return
        self._clear(session)
        put()

    def end_trip(self, session: ModbusSession) -> None:
        """End a trip with the output unchanged; raise DeviceError if a step fails."""
        if self._has == "none" or not self._has.clear or not self._tripped(session):
            return
        if self._has.on_trip == "hold":
            self._clear(session)
            return
        value = self._trip_value(session, self._has)
        if value is None:
            raise DeviceError(
                "its watchdog has tripped, and where that has put the output is not known: "
                "'hilctl safe' puts it at the safe value and clears the trip"
            )
        output, data = self._setup.output, self._setup.output.format.encode(value)
        self.write_through(session, lambda: session.write_bytes(output, data))

    def _tripped(self, session: ModbusSession) -> bool:
        has, output = self._has, self._setup.output
        assert has != "none"
        if has.tripped != "none":
            return session.is_set(has.tripped)
        held = session.held_data(output) if has.refuses_while_tripped else None
        try:  # what it holds already moves nothing
            if held is not None:
                session.write_bytes(output, held)
        except RefusedError:
            return True
        return False

    def _trip_value(self, session: ModbusSession, has: ModbusWatchdog) -> float | None:
        """Return what a tripped device outputs, in the output's unit; None if not known."""
        output = self._setup.output
        for step in has.safe.get(self._setup.options.output, ()):
            if isinstance(step, RegisterStep) and step.value == "safe":
                scaled = step.model_copy(update={"scale": output.scale, "offset": output.offset})
                return scaled.format.decode(session.read_bytes(scaled))
        if has.on_trip in {"zero", "reset"}:
            return 0.0
        if self._wanted == "none" or has.on_trip != "safe":
            return None
        return self._setup.chain.output(self._wanted.safe_command)

    def _clear(self, session: ModbusSession) -> None:
        assert self._has != "none"
        session.run(self._bound(self._has, self._has.clear) or self._has.clear)

    def plan(self, ticks_per_s: float) -> None:
        """Take the rate of exchanges, or raise DeviceError if it is too low to feed it."""
        self._ticks = self.feed_every = 0
        if self._wanted == "none" or self._has == "none":
            return
        ticks = check_feeds(self._wanted.timeout_s, ticks_per_s)
        if self._has.kick == "strict":
            self.feed_every = ticks

    def arm(self, session: ModbusSession) -> None:
        """Set safe value and timeout and start it, if the experiment wants one."""
        has = self._has
        if self._wanted == "none" or has == "none":
            return
        # The safe value before the timeout: once it counts, it must know where to go.
        steps = self._bound(has, (*has.safe.get(self._setup.options.output, ()), *has.arm))
        if session.would_change(steps):
            session.run(self._bound(has, has.unlock))
        session.run(steps)

    def disarm(self, session: ModbusSession) -> None:
        """Stop it, if the experiment wants one."""
        if self._has != "none":
            session.run(self._bound(self._has, self._has.disarm))

    def feed(self, session: ModbusSession) -> None:
        """Feed a watchdog that exchanges do not feed, three times per timeout."""
        self._ticks += 1
        if self._ticks % self.feed_every == 0 and self._has != "none":
            session.run(self._bound(self._has, self._has.feed))

    def _bound(self, has: ModbusWatchdog, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return steps with the experiment's timeout and safe value in them; none without one."""
        if self._wanted == "none":
            return ()
        safe = self._setup.chain.output(self._wanted.safe_command)
        return has.bound(steps, self._setup.output, self._wanted.timeout_s, safe)


Connect: TypeAlias = Callable[[Endpoint], ModbusSession]
"""Makes a session on a new link."""


class ModbusSafeWrite:
    """Writes the output of a device, one attempt per call."""

    def __init__(self, setup: ModbusSetup, connect: Connect) -> None:
        self._setup = setup
        self._connect = connect
        self._guard = ModbusWatchdogDriver(setup)
        self._exchange = SafeExchange()
        self._session: ModbusSession | None = None

    def attempt(self, peer: Endpoint, value: float, opened: ModbusSession | None = None) -> None:
        """Write the output and have the device confirm it; the link is closed afterwards.

        Args:
            peer: The device; best with a numeric address, which needs no name server.
            value: In the output's unit.
            opened: A session on an open line without framing; None to open a connection.
        """
        if opened is None and self._session is not None:
            opened = self._session  # which knows whether answers are outstanding on the line
        session = opened or self._connect(peer)
        link = session.link
        try:
            # No self-test, no init steps, no reader: none of them may cost the safe value.
            if isinstance(link, StreamLink):
                self._session = session
                self._exchange.attempt(
                    link,
                    lambda: link.send_now(self._request(session, value)),
                    lambda: self._write(session, value),
                )
            else:
                # A new connection: no answer to an older command can come on it.
                link.open()
                self._write(session, value)
        finally:
            link.close()

    def try_out(self, session: ModbusSession) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self._setup.output
        data = session.held_data(output)
        if data is not None:
            name = f"{self._setup.options.output}, register {output.address}"
            value = output.format.decode(data)
            try_out(output, value, lambda: self._put(session, data), f"to {name}")

    def _request(self, session: ModbusSession, value: float) -> bytes:
        output = self._setup.output
        pdu = write_request(session.profile, output, output.format.encode(value))
        return session.prepare(pdu).request()

    def _write(self, session: ModbusSession, value: float) -> None:
        data = self._setup.output.format.encode(value)
        self._guard.write_through(session, lambda: self._put(session, data))
        if self._setup.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self._setup.unconfirmed}")
        found, output = self._held(session), self._setup.output
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def _put(self, session: ModbusSession, data: bytes) -> None:
        """Write the output's register bytes once."""
        session.write_bytes(self._setup.output, data)

    def _held(self, session: ModbusSession) -> float | None:
        """Return the content of the output's register; None if it cannot be read."""
        return session.held(self._setup.output)
