"""The host watchdog of a Modbus device during a run: cleared, armed, fed, disarmed."""

from hilctl_drivers.feed_time import check_feeds
from hilctl_drivers.modbus.profile import ModbusWatchdog
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.modbus.setup import ModbusSetup


class ModbusGuard:
    """The watchdog, as the experiment wants it.

    Args:
        setup: What the experiment says of the device.
    """

    def __init__(self, setup: ModbusSetup) -> None:
        self._setup = setup
        self._ticks = 0
        self.feed_every = 0
        """Ticks from one feeding to the next; 0 where exchanges feed it."""

    def clear_trip(self, session: ModbusSession) -> None:
        """Clear a trip of an earlier run; the output stays where the watchdog has put it.

        Raises:
            DeviceError: A step failed.
        """
        watchdog = self._setup.profile.watchdog
        if watchdog == "none" or not watchdog.clear:
            return
        if watchdog.tripped == "none" or session.is_set(watchdog.tripped):
            session.run(self._setup.bound(watchdog.clear) or watchdog.clear)

    def arm(self, session: ModbusSession, sample_rate_hz: float) -> None:
        """Set safe value and time-out and start it, where the experiment wants one.

        Raises:
            DeviceError: A step failed, or samples come too seldom to feed it.
        """
        wanted, watchdog = self._setup.options.watchdog, self._setup.profile.watchdog
        self._ticks = self.feed_every = 0
        if wanted == "none" or watchdog == "none":
            return
        ticks = check_feeds(wanted.timeout_s, sample_rate_hz)
        safe = watchdog.safe.get(self._setup.options.output, ())
        steps = self._setup.bound((*safe, *watchdog.arm))
        if session.would_change(steps):
            self._run(session, "unlock")
        session.run(steps)
        if watchdog.kick == "strict":
            self.feed_every = ticks

    def disarm(self, session: ModbusSession) -> None:
        """Stop it, where the experiment wanted one.

        Raises:
            DeviceError: A step failed.
        """
        self._run(session, "disarm")

    def feed(self, session: ModbusSession) -> None:
        """Feed a watchdog that exchanges don't feed; three times in its timeout.

        Raises:
            DeviceError: A step failed.
        """
        self._ticks += 1
        if self._ticks % self.feed_every == 0:
            self._run(session, "feed")

    def _run(self, session: ModbusSession, name: str) -> None:
        watchdog = self._setup.profile.watchdog
        if self._setup.options.watchdog != "none" and isinstance(watchdog, ModbusWatchdog):
            session.run(self._setup.bound(getattr(watchdog, name)))
