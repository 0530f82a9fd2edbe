"""The host watchdog of a Modbus device during a run: cleared, armed, fed, disarmed."""

from hilctl_drivers.modbus.channels import ModbusStep
from hilctl_drivers.modbus.profile import ModbusWatchdog
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.wire.timing import check_feeds


class ModbusGuard:
    """The watchdog, as the experiment wants it.

    Args:
        setup: What the experiment says of the device.
    """

    def __init__(self, setup: ModbusSetup) -> None:
        self._setup = setup
        self._wanted = setup.options.watchdog
        self._has = setup.writer.profile.watchdog
        self._ticks = 0
        self.feed_every = 0
        """Ticks from one feeding to the next; 0 where exchanges feed it."""

    def clear_trip(self, session: ModbusSession) -> None:
        """Clear a trip of an earlier run; the output stays where the watchdog has put it.

        Raises:
            DeviceError: A step failed.
        """
        has = self._has
        if has == "none" or not has.clear:
            return
        if has.tripped == "none" or session.is_set(has.tripped):
            session.run(self._bound(has, has.clear) or has.clear)

    def arm(self, session: ModbusSession, ticks_per_s: float) -> None:
        """Set safe value and time-out and start it, where the experiment wants one.

        Raises:
            DeviceError: A step failed, or exchanges come too seldom to feed it.
        """
        has = self._has
        self._ticks = self.feed_every = 0
        if self._wanted == "none" or has == "none":
            return
        ticks = check_feeds(self._wanted.timeout_s, ticks_per_s)
        # The safe value before the time-out: once it counts, it must know where to go.
        steps = self._bound(has, (*has.safe.get(self._setup.options.output, ()), *has.arm))
        if session.would_change(steps):
            session.run(self._bound(has, has.unlock))
        session.run(steps)
        if has.kick == "strict":
            self.feed_every = ticks

    def disarm(self, session: ModbusSession) -> None:
        """Stop it, where the experiment wanted one.

        Raises:
            DeviceError: A step failed.
        """
        if self._has != "none":
            session.run(self._bound(self._has, self._has.disarm))

    def feed(self, session: ModbusSession) -> None:
        """Feed a watchdog that exchanges don't feed; three times in its timeout.

        Raises:
            DeviceError: A step failed.
        """
        self._ticks += 1
        if self._ticks % self.feed_every == 0 and self._has != "none":
            session.run(self._bound(self._has, self._has.feed))

    def _bound(self, has: ModbusWatchdog, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return steps with the experiment's timeout and safe value in them; none without one."""
        if self._wanted == "none":
            return ()
        safe = self._setup.chain.output(self._wanted.safe_command)
        return has.bound(steps, self._setup.output, self._wanted.timeout_s, safe)
