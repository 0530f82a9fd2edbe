"""What an experiment says of a Modbus device, held against the device's profile."""

from dataclasses import dataclass
from typing import Literal, Self, TypeVar, cast

from pydantic import Field, model_validator

from hilctl.errors import InputError
from hilctl.ports import DeviceInfo, DeviceOptions
from hilctl_drivers.links import Link, SerialLink, SerialSettings, TcpLink
from hilctl_drivers.modbus_session import ModbusSession
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.profile_links import RtuLink
from hilctl_drivers.profile_modbus import (
    ModbusInput,
    ModbusOutput,
    ModbusProfile,
    ModbusStep,
    ModbusWatchdog,
)
from hilctl_drivers.profile_parts import Register
from hilctl_drivers.signal_chain import Amplifier, Calibration, Sensor, SignalChain
from hilctl_drivers.wire_time import WireTime, exchange_time

_Channel = TypeVar("_Channel", ModbusInput, ModbusOutput)


class HostWatchdog(DeviceOptions):
    """What the device does by itself when this machine falls silent."""

    timeout_s: float = Field(gt=0.0, description="silence after which it acts, s")
    safe_command: float = Field(
        default=0.0, description="where it puts the output, in the command's unit"
    )


class ModbusOptions(DeviceOptions):
    """Options of ``modbus_dac``."""

    profile: str = Field(description="name of a shipped profile, or path of your own")
    host: str | None = Field(default=None, description="name or address, for Modbus TCP")
    port: int | None = Field(default=None, ge=1, le=65535, description="TCP port; else the usual")
    serial_port: str | None = Field(
        default=None, description="device file, for Modbus RTU; best under /dev/serial/by-id"
    )
    baud: int | None = Field(default=None, ge=300, description="else the profile's")
    parity: Literal["N", "E", "O"] | None = Field(default=None, description="else the profile's")
    stopbits: Literal[1, 2] | None = Field(default=None, description="else the profile's")
    unit_id: int | None = Field(default=None, ge=0, le=255, description="else the profile's")
    output: str = Field(description="output that drives the actuator")
    input: str = Field(description="input that the displacement sensor is wired to")
    timeout_s: float = Field(
        default=0.1, gt=0.0, le=60.0, description="longest wait for one answer, s"
    )
    amplifier: Amplifier | None = Field(
        default=None, description="left out only where the output is in A and drives the coil"
    )
    sensor: Sensor
    calibration: Calibration | None = None
    watchdog: HostWatchdog | Literal["none"] = Field(
        description="the device's own; none says that you know it would hold its last output"
    )

    @model_validator(mode="after")
    def _one_wire(self) -> Self:
        if (self.host is None) == (self.serial_port is None):
            raise ValueError("must have either host or serial_port")
        if self.serial_port is None and (self.baud or self.parity or self.stopbits):
            raise ValueError("baud, parity and stopbits go with serial_port")
        if self.host is None and self.port is not None:
            raise ValueError("port goes with host")
        return self


def _modbus_profile(options: ModbusOptions) -> ModbusProfile:
    """Return the profile, with the experiment's line settings in it."""
    profile = load_profile(options.profile)
    if not isinstance(profile, ModbusProfile):
        raise InputError(f"profile {options.profile} is not one of a Modbus device")
    link = profile.link
    wanted = "host" if link.kind == "tcp" else "serial_port"
    if getattr(options, wanted) is None:
        raise InputError(f"profile {options.profile} is for Modbus {link.kind}: give {wanted}")
    if isinstance(link, RtuLink):
        given = {"baud": options.baud, "parity": options.parity, "stopbits": options.stopbits}
        changes = {key: value for key, value in given.items() if value is not None}
        return cast(ModbusProfile, with_link(profile, **changes)) if changes else profile
    return profile


@dataclass(frozen=True, slots=True)
class ModbusSetup:
    """What an experiment's options come to.

    Attributes:
        options: The options.
        profile: The profile.
        output: The output in use.
        input: The input in use.
        chain: What they are wired to.
    """

    options: ModbusOptions
    profile: ModbusProfile
    output: ModbusOutput
    input: ModbusInput
    chain: SignalChain

    @classmethod
    def of(cls, options: ModbusOptions) -> "ModbusSetup":
        """Load the profile and hold the options against it.

        Raises:
            InputError: They don't go together.
        """
        profile = _modbus_profile(options)
        output = _channel("output", options.output, profile.outputs, profile.title)
        sensor_input = _channel("input", options.input, profile.inputs, profile.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        setup = cls(options, profile, output, sensor_input, chain)
        setup.check()
        return setup

    def check(self) -> None:
        """Refuse a time-out that is too short, and a watchdog that can't do what is asked of it."""
        wire = self.wire(self.may_combine)
        if self.options.timeout_s <= wire.total_s:
            raise InputError(
                f"timeout_s must be > {wire.total_s:g}, got {self.options.timeout_s:g} ({wire})"
            )
        wanted, has = self.options.watchdog, self.profile.watchdog
        if wanted == "none":
            return
        if has == "none":
            raise InputError(
                f"{self.profile.title} has no host watchdog: it holds its last output when this "
                "machine dies; say watchdog: none if you accept that"
            )
        has.counts(wanted.timeout_s)
        low, high = self.chain.command_range(*self.output.limits)
        if not low <= wanted.safe_command <= high:
            raise InputError(
                f"watchdog.safe_command must be {low:g} to {high:g}, got {wanted.safe_command:g}"
            )
        self._check_trip(has, wanted.safe_command)

    def _check_trip(self, watchdog: ModbusWatchdog, wanted: float) -> None:
        """Refuse a safe command that the device would not go to."""
        name, unit = self.options.output, self.chain.command_unit
        if watchdog.on_trip == "safe" and watchdog.safe and name not in watchdog.safe:
            raise InputError(
                f"the watchdog of {self.profile.title} does nothing for {name}, only for "
                f"{', '.join(watchdog.safe)}: take one of these, or say watchdog: none"
            )
        at_zero = self.chain.command(0.0)
        if watchdog.on_trip in {"zero", "reset"} and abs(at_zero - wanted) > 1e-9:
            raise InputError(
                f"the watchdog of {self.profile.title} puts {name} at 0 {self.output.unit}, which "
                f"is {at_zero:g} {unit} here: watchdog.safe_command must be that, got {wanted:g}"
            )

    def link(self) -> Link:
        """Return a new link to the device."""
        options, link = self.options, self.profile.link
        if link.kind == "tcp":
            assert options.host is not None
            return TcpLink(options.host, options.port or link.port, options.timeout_s)
        assert options.serial_port is not None
        settings = SerialSettings(
            link.baud, link.bytesize, link.parity, link.stopbits, link.frame_gap_s, link.boot_wait_s
        )
        return SerialLink(options.serial_port, settings, options.timeout_s)

    @property
    def unit(self) -> int:
        """The device's unit id."""
        return self.profile.unit_id if self.options.unit_id is None else self.options.unit_id

    @property
    def title(self) -> str:
        """The device in messages: its profile and where it is."""
        return f"modbus_dac {self.options.profile} at {self.link().name}"

    @property
    def may_combine(self) -> bool:
        """Whether a sample may be one transaction; :meth:`ModbusDac.open` finds out.

        Trying it moves an output that can't be read back, so it is not tried there.
        """
        return self.profile.exchange != "none" and self.output.readback_register is not None

    def wire(self, one_transaction: bool) -> WireTime:
        """Return what a sample costs on the wire."""
        names = (self.options.output, self.options.input)
        return exchange_time(self.profile, *names, one_transaction=one_transaction)

    def rate(self, one_transaction: bool) -> tuple[float, str]:
        """Return the highest sample rate, in Hz, and why it is that.

        Args:
            one_transaction: Whether a sample is one transaction, not a write and a read.
        """
        wire, most_hz = self.wire(one_transaction), self.profile.max_rate_hz
        if wire.highest_rate_hz <= most_hz:
            return wire.highest_rate_hz, str(wire)
        return most_hz, f"its profile says so; the wire alone: {wire}"

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        profile, options = self.profile, self.options
        low, high = self.chain.command_range(*self.output.limits)
        low_um, high_um = self.chain.displacement_range(*self.input.limits)
        highest_hz, note = self.rate(self.may_combine)
        return DeviceInfo(
            name="modbus_dac",
            description=f"{profile.title} at {self.link().name}: {options.output}, {options.input}",
            command_unit=self.chain.command_unit,
            command_min=low,
            command_max=high,
            sensor_min_um=low_um,
            sensor_max_um=high_um,
            max_rate_hz=highest_hz,
            rate_note=note,
            details=self.details(),
        )

    def details(self) -> dict[str, str]:
        """Return what is worth keeping with a recording, as text."""
        profile, options = self.profile, self.options
        kept = options.model_dump(exclude_none=True)
        return {
            "vendor": profile.vendor,
            "model": profile.model,
            "source": "; ".join(profile.source),
            "verified": profile.verified,
            "link": profile.link.model_dump_json(),
            **{name: str(value) for name, value in kept.items()},
        }

    def address(self, register: Register) -> int:
        """Return a register's address in a frame."""
        return self.profile.wire_address(register)

    def bound(self, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return watchdog steps with the experiment's timeout and safe value in them."""
        wanted, watchdog = self.options.watchdog, self.profile.watchdog
        if wanted == "none" or watchdog == "none":
            return ()
        safe = self.chain.output(wanted.safe_command)
        return watchdog.bound(steps, self.output, wanted.timeout_s, safe)

    def session(self) -> ModbusSession:
        """Return a session on a new link."""
        return ModbusSession(self.profile, self.link(), self.unit)


def _channel(what: str, name: str, channels: dict[str, _Channel], title: str) -> _Channel:
    if name in channels:
        return channels[name]
    known = ", ".join(channels) or "none"
    raise InputError(f"{what} must be one that {title} has, got {name!r} (it has {known})")
