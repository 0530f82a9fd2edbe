"""Options of a Modbus device, resolved against its profile."""

from dataclasses import dataclass
from typing import Any, Literal, cast

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import InputError
from hilctl_drivers.dac_setup import DacSetup, SessionReader
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import (
    ModbusSession,
    arm_s,
    exchange_time,
    feed_time,
    read_requests,
    read_time,
)
from hilctl_drivers.signal_chain import DacOptions, Measure
from hilctl_drivers.transport.links import Link
from hilctl_drivers.transport.wire_time import RateLimit, WireTime


class ModbusOptions(DacOptions):
    """Options of ``modbus_dac``."""

    measure: Measure = None


def session_at(endpoint: Endpoint, link: Link | None = None) -> ModbusSession:
    """Return a session with a device, on a link that it shares with others or on a new one."""
    profile, unit = cast(ModbusProfile, endpoint.profile), endpoint.unit
    assert unit is not None, "Modbus devices have an address"
    framing: Literal["tcp", "rtu"] = "tcp" if endpoint.framing == "tcp" else "rtu"
    return ModbusSession(profile, link or endpoint.link(), unit, framing=framing)


@dataclass(frozen=True, slots=True)
class ModbusSetup(DacSetup):
    """An experiment's options, resolved against the profiles."""

    output: ModbusOutput
    input: Any

    @classmethod
    def of(cls, options: DacOptions) -> "ModbusSetup":
        """Resolve options, or raise InputError if they do not fit their profiles."""
        if not isinstance(options.profile.profile, ModbusProfile):
            name, kind = options.profile.name, options.profile.profile.DEVICE
            raise InputError(f"profile {name} is one for kind: {kind}, not Modbus")
        setup = super(ModbusSetup, cls).of(options)
        setup.check_timeout(setup.wire(setup.may_combine))
        return setup

    @property
    def profile(self) -> ModbusProfile:
        """The profile of the device that has the output."""
        return cast(ModbusProfile, self.writer.profile)

    @property
    def may_combine(self) -> bool:
        """Whether a sample may be one transaction; :meth:`ModbusDac.open` finds out.

        Trying it moves an output that cannot be read back, so it is not tried there.
        """
        if self.reads_elsewhere:
            return False
        return self.profile.exchange != "none" and self.output.readback_register is not None

    @property
    def unconfirmed(self) -> str:
        """Why a value that was written cannot be confirmed, as text; empty if it can."""
        output = self.output
        if (
            output.readback_register is not None
            or output.function != 6
            or self.writer.framing == "tcp"
        ):
            return ""
        # The correct reply equals the request, and is what a line that echoes gives.
        return (
            "the device cannot confirm it: on a serial line the reply to function 6 may be an echo,"
            " and the output cannot be read back"
        )

    def wire(self, one_transaction: bool) -> WireTime:
        """Return the time of a sample on the wire."""
        own = None if self.reads_elsewhere else self.options.input
        wire = exchange_time(
            self.profile, self.options.output, own, one_transaction=one_transaction
        )
        if self.measure is not None:
            wire = wire.then(read_time(self.profile, self.measure).named("to measure the output"))
        return self.after_reading(wire)

    def transactions(self, one_transaction: bool) -> int:
        """Return the number of requests of a sample."""
        count = 1 if one_transaction else 2
        if isinstance(self.input, ModbusInput):
            count += len(read_requests(cast(ModbusProfile, self.reader.profile), self.input)) - 1
        if self.measure is not None:
            count += len(read_requests(self.profile, self.measure))
        return count + (self.profile.error_register != "none")

    def sample_rates(self, one_transaction: bool) -> RateLimit:
        """Return the sample rates that wire and devices allow."""
        wire = self.wire(one_transaction)
        if self.options.watchdog != "none":
            wire = wire.then(feed_time(self.profile))
        return self.rates(wire)

    def described(self, kind: str, rates: RateLimit, **more: Any) -> DeviceInfo:
        """Return what the device is and what it accepts, see :meth:`DacSetup.info`."""
        options = self.options
        return self.info(
            kind,
            rates,
            measures_command=self.measure is not None,
            arm_s=0.0 if options.watchdog == "none" else arm_s(self.profile, options.output),
            confirms=not self.unconfirmed,
            safe_note=self.unconfirmed,
            **more,
        )


class ModbusReader(SessionReader):
    """A :class:`~hilctl_drivers.dac_setup.SensorReader` for Modbus."""

    session_on = staticmethod(session_at)
    time = staticmethod(read_time)
