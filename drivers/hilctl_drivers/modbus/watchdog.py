"""Host watchdog of a Modbus device."""

from collections.abc import Callable
from contextlib import suppress
from typing import cast

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile, ModbusWatchdog
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.register_map import ModbusStep, RegisterStep
from hilctl_drivers.transport.links import RefusedError
from hilctl_drivers.transport.wire_time import check_feeds


class ModbusWatchdogDriver:
    """The watchdog, as the experiment wants it."""

    def __init__(self, setup: DacSetup) -> None:
        self._setup = setup
        self._target = cast(ModbusOutput, setup.output)
        self._wanted = setup.options.watchdog
        self._has = cast(ModbusProfile, setup.writer.profile).watchdog
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
        output, data = self._target, self._target.format.encode(value)
        self.write_through(session, lambda: session.write_bytes(output, data))

    def _tripped(self, session: ModbusSession) -> bool:
        has, output = self._has, self._target
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
        output = self._target
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
        return has.bound(steps, self._target, self._wanted.timeout_s, safe)
