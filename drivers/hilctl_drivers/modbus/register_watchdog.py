"""Host watchdog of a Modbus device, set by the steps of its profile."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import cast

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile, ModbusWatchdog
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.register_map import ModbusStep, RegisterStep
from hilctl_drivers.transport.links import RefusedError
from hilctl_drivers.wire import HostWatchdog


class RegisterWatchdog(HostWatchdog):
    """A watchdog in registers."""

    def __init__(self, setup: DacSetup, session: ModbusSession) -> None:
        self._session = session
        self._options, self._chain = setup.options, setup.chain
        self._target = cast(ModbusOutput, setup.output)
        profile: ModbusProfile = session.profile
        self._has = profile.watchdog
        self.joined: Sequence[RegisterWatchdog] = (self,)
        """The watchdogs of the outputs that a run drives; their device has one."""
        self.arm_s = session.arm_s(profile, setup.options.output)

    def arm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.arm`."""
        has = self._has
        if has == "none":
            return
        steps = self._bound(has.arming(self._options.output))
        if self._session.would_change(steps):
            self._session.run(self._bound(has.unlock))
        self._session.run(steps)

    def disarm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.disarm`."""
        if self._has != "none":
            self._session.run(self._bound(self._has.disarm))

    def feed(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.feed`."""
        if self._has != "none":
            self._session.run(self._bound(self._has.feed))

    def tripped(self) -> bool:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.tripped`."""
        if self._has == "none" or self._has.tripped == "none":
            return False
        return self._session.is_set(self._has.tripped)

    def _bound(self, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return steps with the experiment's timeout and safe value in them; none without one."""
        has, wanted = self._has, self._options.watchdog
        if has == "none" or wanted == "none":
            return ()
        safe = self._chain.output(wanted.safe_command)
        return has.bound(steps, self._target, wanted.timeout_s, safe)

    def recover(self) -> None:
        """End a trip with the output unchanged; raise DeviceError if a step fails."""
        has = self._has
        if has == "none" or not has.clear or not self._is_tripped(has):
            return
        if has.on_trip == "hold":
            self._clear(has)
            return
        # Of all outputs: each would return to its last command when the trip is cleared.
        writes = [each.trip_write(has) for each in self.joined]

        def put() -> None:
            for write in writes:
                write()

        self.write_through(put)

    def trip_write(self, has: ModbusWatchdog) -> Callable[[], None]:
        """Return a function that writes the output of a tripped device once more."""
        value, output = self._trip_value(has), self._target
        if value is None:
            raise DeviceError(
                "its watchdog has tripped and the output is unknown: "
                "'hilctl safe' puts it at the safe value and clears the trip"
            )
        return partial(self._session.write_bytes, output, output.format.encode(value))

    def _is_tripped(self, has: ModbusWatchdog) -> bool:
        output, session = self._target, self._session
        if has.tripped != "none":
            return session.is_set(has.tripped)
        held = session.held_data(output) if has.refuses_while_tripped else None
        try:  # writing the present value moves nothing
            if held is not None:
                session.write_bytes(output, held)
        except RefusedError:
            return True
        return False

    def _trip_value(self, has: ModbusWatchdog) -> float | None:
        """Return the output of a tripped device, in the output's unit; None if unknown."""
        output, wanted = self._target, self._options.watchdog
        for step in has.safe.get(self._options.output, ()):
            if isinstance(step, RegisterStep) and step.value == "safe":
                scaled = step.model_copy(update={"scale": output.scale, "offset": output.offset})
                return scaled.format.decode(self._session.read_bytes(scaled))
        if has.on_trip in {"zero", "reset"}:
            return 0.0
        if wanted == "none" or has.on_trip not in {"safe", "stored"}:
            return None
        return float(self._chain.output(wanted.safe_command))

    def _clear(self, has: ModbusWatchdog) -> None:
        self._session.run(self._bound(has.clear) or has.clear)

    def write_through(self, put: Callable[[], None]) -> None:
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
            if has.tripped == "none" or not self._session.is_set(has.tripped):
                return
        self._clear(has)
        put()
