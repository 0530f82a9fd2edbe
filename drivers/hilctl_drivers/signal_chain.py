"""Options of a DAC with a profile: its address, and the wiring of its terminals.

The profile describes the terminals. The options select the output and the input, describe amplifier
and sensor, and name the reader if another device reads the sensor.
command = gain * output + offset, displacement = sensitivity * input + offset.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from ipaddress import ip_address
from typing import Annotated, Literal, Self, TypeAlias, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from hilctl.base.calibration import AmplifierCalibration, CalibrationDate, NamedCalibration
from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl.base.strict import StrictModel
from hilctl.base.types import F64, CommandUnit
from hilctl_drivers.device import CalibrationName
from hilctl_drivers.profile import ProfileName
from hilctl_drivers.profile_base import Name, Range, Watchdog

PROFILE = "name of a shipped profile, or path of your own relative to the experiment's folder"

_Channel = TypeVar("_Channel", bound=Range)
_Value = TypeVar("_Value", float, F64)
_SENSITIVITIES = {unit: f"um_per_{unit.lower()}" for unit in ("V", "mA", "um", "mm", "nm")}
_TIMEOUT_S, _TIMEOUT_PERIODS = 0.1, 3.0
_GAINS = ("gain_a_per_v", "gain_a_per_ma", "gain_v_per_v", "gain_v_per_ma")


class Amplifier(StrictModel):
    """The power amplifier at the output; set one gain."""

    gain_a_per_v: float | None = Field(default=None, description="coil current per volt, A/V")
    gain_a_per_ma: float | None = Field(default=None, description="coil current per mA, A/mA")
    gain_v_per_v: float | None = Field(default=None, description="drive voltage per volt, V/V")
    gain_v_per_ma: float | None = Field(default=None, description="drive voltage per mA, V/mA")
    offset_a: float = Field(default=0.0, description="coil current at output 0, A")
    offset_v: float = Field(default=0.0, description="drive voltage at output 0, V")

    @model_validator(mode="after")
    def _one_gain(self) -> Self:
        if len(self._given) != 1 or self.gain == 0.0:
            raise ValueError(f"must have one of {', '.join(_GAINS)}, and not 0")
        wrong = self.offset_v if self.command_unit == "A" else self.offset_a
        if wrong:
            raise ValueError("offset must be in the unit that the gain leads to")
        return self

    @property
    def _given(self) -> list[str]:
        return [name for name in _GAINS if getattr(self, name) is not None]

    @property
    def command_unit(self) -> CommandUnit:
        """Unit of the command to the actuator."""
        return "A" if self._given[0].startswith("gain_a") else "V"

    @property
    def output_unit(self) -> str:
        """Unit of the output that it is wired to."""
        return "mA" if self._given[0].endswith("ma") else "V"

    @property
    def gain(self) -> float:
        """Command for one unit of the output."""
        return float(getattr(self, self._given[0]))

    @property
    def offset(self) -> float:
        """Command at 0 of the output."""
        return self.offset_a + self.offset_v


class Sensor(StrictModel):
    """The displacement sensor at the input; set one sensitivity, unless the input is a position."""

    um_per_v: float | None = Field(default=None, description="displacement per volt, um/V")
    um_per_ma: float | None = Field(default=None, description="displacement per mA, um/mA")
    um_per_um: float | None = Field(
        default=None, description="displacement per um of a position; default: 1; -1 reverses it"
    )
    um_per_mm: float | None = Field(
        default=None,
        description="displacement per mm of a position; default: 1000; -1000 reverses it",
    )
    um_per_nm: float | None = Field(
        default=None,
        description="displacement per nm of a position; default: 0.001; -0.001 reverses it",
    )
    offset_um: float = Field(default=0.0, description="displacement at input 0, um")

    @model_validator(mode="after")
    def _one_sensitivity(self) -> Self:
        if len(self._given) > 1 or 0.0 in self._given.values():
            raise ValueError(f"must have one of {', '.join(_SENSITIVITIES.values())}, and not 0")
        return self

    @property
    def _given(self) -> dict[str, float]:
        """The sensitivity by unit of the input; empty if it is not set."""
        found = {unit: getattr(self, name) for unit, name in _SENSITIVITIES.items()}
        return {unit: value for unit, value in found.items() if value is not None}

    def um_per_unit(self, source: Range) -> float:
        """Return the displacement for one unit of an input, um; raise InputError without one."""
        default = source.per_unit("um")
        if not self._given and default is not None:
            return default
        if source.unit not in _SENSITIVITIES:
            raise InputError(f"no sensor gives {source.unit}, the unit of the input")
        if source.unit not in self._given:
            got = ", ".join(_SENSITIVITIES[unit] for unit in self._given) or "nothing"
            wanted = _SENSITIVITIES[source.unit]
            raise InputError(f"sensor must have {wanted}: the input is in {source.unit}, got {got}")
        return self._given[source.unit]


class Calibration(StrictModel):
    """Calibration of gain and sensitivity, as a note that is kept with each recording."""

    date: CalibrationDate = Field(description="date of the calibration")
    by: str = Field(description="person who calibrated")
    reference: str = Field(description="reference standard, or document")


class WatchdogOptions(StrictModel):
    """The device's own watchdog, which trips if the host stops sending."""

    timeout_s: float = Field(gt=0.0, description="silence before a trip, s")
    safe_command: float = Field(
        default=0.0, description="command after a trip, in the command's unit"
    )
    reason: str = Field(
        default="", description="reason for a safe_command other than the experiment's safe value"
    )


_NAME = re.compile(r"(?=.{1,253}\Z)\w([\w-]{0,61}\w)?(\.\w([\w-]{0,61}\w)?)*\.?")
_NAME_AND_PORT = re.compile(r"\[?(.*?)\]?:(\d+)")


def _host(host: str) -> str:
    if _NAME.fullmatch(host):
        return host
    with suppress(ValueError):
        ip_address(host)
        return host
    given = _NAME_AND_PORT.fullmatch(host)
    if given:
        name, port = given.groups()
        raise ValueError(f"must have no port: set host to {name} and tcp_port to {port}")
    raise ValueError(f"must be a host name or an IP address, got {host!r}")


def _device_file(path: str) -> str:
    if not path.strip() or not path.isprintable():
        raise ValueError(f"must be a device file (hilctl devices lists them), got {path!r}")
    return path


HostName: TypeAlias = Annotated[str, AfterValidator(_host)]

LINE = ("baud", "parity", "stopbits", "echo", "gap_s")
"""Settings of a serial line, at a port of this machine or behind a gateway or serial server."""
PORT = ("boot_wait_s", "dtr", "rts", "rs485")
"""Settings of a serial port of this machine."""
STREAM = ("max_age_s",)
"""Settings of a sensor that sends unsolicited samples."""


class AddressOptions(DeviceOptions):
    """Profile and address of a device."""

    profile: ProfileName = Field(description=PROFILE)
    host: HostName | None = Field(
        default=None,
        description="host name or address of the device, of a gateway to Modbus RTU, or of a"
        " serial server",
    )
    tcp_port: int | None = Field(
        default=None, ge=1, le=65535, description="TCP port; default: the profile's; 502 for Modbus"
    )
    framing: Literal["tcp", "rtu"] | None = Field(
        default=None,
        description="frames of Modbus at host: tcp, or rtu for a serial server that passes bytes"
        " on; default: the profile's, tcp for Modbus RTU",
    )
    serial_port: Annotated[str, AfterValidator(_device_file)] | None = Field(
        default=None, description="device file, preferably under /dev/serial/by-id"
    )
    unit_id: int | None = Field(
        default=None, ge=0, le=255, description="address on a shared line; default: the profile's"
    )
    baud: int | None = Field(default=None, ge=300, description="default: the profile's")
    parity: Literal["N", "E", "O"] | None = Field(
        default=None, description="default: the profile's"
    )
    stopbits: Literal[1, 2] | None = Field(default=None, description="default: the profile's")
    echo: bool | None = Field(
        default=None,
        description="whether the adapter receives what it sends; default: the profile's, or false",
    )
    gap_s: float | None = Field(
        default=None, ge=0.0, description="silence before each request, s; default: the profile's"
    )
    boot_wait_s: float | None = Field(
        default=None, ge=0.0, le=30.0, description="wait after opening the port, s; default: the"
        " profile's",
    )  # fmt: skip
    dtr: bool | None = Field(default=None, description="level of DTR; default: the profile's")
    rts: bool | None = Field(default=None, description="level of RTS; default: the profile's")
    max_age_s: float | None = Field(
        default=None,
        gt=0.0,
        description="age from which a reading of a sensor that sends unasked is invalid, s;"
        " default: the profile's",
    )
    rs485: Literal["high", "low"] | None = Field(
        default=None,
        description="level of RTS while sending, switched by the kernel (TIOCSRS485); omitted if"
        " the adapter switches its direction itself",
    )

    @model_validator(mode="after")
    def _settings_go_with_their_place(self) -> Self:
        if self.host is not None and self.serial_port is not None:
            rule = "must have one of host and serial_port, not both: set the other to null"
            raise ValueError(rule)
        places = {
            "host": (self.host, ("tcp_port", "framing")),
            "serial_port": (self.serial_port, PORT),
            "serial_port or host": (self.serial_port or self.host, (*LINE, *STREAM)),
        }
        wrong = [
            f"{', '.join(given)} must go with {name}"
            for name, (place, keys) in places.items()
            if place is None and (given := [key for key in keys if getattr(self, key) is not None])
        ]
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


FifoBlocks: TypeAlias = Annotated[
    int,
    Field(
        ge=1,
        le=1024,
        description="blocks kept in the FIFO of a streaming device: the longest stall of the host,"
        " and the delay of the displacements",
    ),
]


Measure: TypeAlias = Annotated[
    str | None,
    Field(
        description="input that measures the output itself, recorded beside the command; it costs"
        " one more request a sample"
    ),
]


class AuxInput(DeviceOptions):
    """Input of an auxiliary channel with the value ``scale`` * reading + ``offset``."""

    input: str = Field(
        description="input of the device that reads the sensor, otherwise of that with the output"
    )
    unit: str | None = Field(default=None, description="unit of the value; default: the input's")
    scale: float = Field(default=1.0, description="value per unit of the input")
    offset: float = Field(default=0.0, description="value at input 0")
    meaning: str = Field(default="", description="comment, kept with each recording")

    @field_validator("scale")
    @classmethod
    def _follows(cls, scale: float) -> float:
        if scale == 0.0:
            raise ValueError("must not be 0, because no limit would trip")
        return scale


class DacOptions(AddressOptions):
    """Options of every DAC with a profile."""

    output: str = Field(description="output that drives the actuator")
    input: str = Field(description="input of the displacement sensor")
    reader: AddressOptions | None = Field(
        default=None,
        description="device with the input, if it is another one; without host and serial_port it"
        " is on the line or connection of the output",
    )
    timeout_s: float | None = Field(
        default=None,
        gt=0.0,
        le=60.0,
        description="longest wait for a reply, s; default: 0.1, and three periods of a device"
        " slower than 30 Hz",
    )
    amplifier: Amplifier | None = Field(
        default=None, description="omitted only if the output is in A and drives the coil"
    )
    sensor: Sensor = Field(
        default=Sensor(), description="displacement sensor; may be omitted for a position"
    )
    calibration: Calibration | CalibrationName | None = Field(
        default=None, description="calibration file to apply, or a note on the last calibration"
    )
    aux: dict[Name, AuxInput] | None = Field(
        default=None,
        description="auxiliary channels by name, such as coil_c; one of them is read per sample, in"
        " turn, which costs one more request",
    )
    digital_output: str | None = Field(
        default=None,
        description="digital output for trigger.output, of the device with the output; low except"
        " for pulses",
    )
    digital_input: str | None = Field(
        default=None, description="digital input for trigger.start, of the device with the output"
    )
    watchdog: WatchdogOptions | Literal["none"] = Field(
        description="the device's own; none if the device may hold its last output"
    )

    @model_validator(mode="after")
    def _can_drive_from_a_place(self) -> Self:
        if not self.profile.profile.outputs:
            raise ValueError(f"profile {self.profile.name} has no output: name it as reader")
        if self.host is None is self.serial_port:
            raise ValueError("must have either host or serial_port")
        return self

    @property
    def reply_timeout_s(self) -> float:
        """Longest wait for a reply, s."""
        if self.timeout_s is not None:
            return self.timeout_s
        devices = (self.profile, *(() if self.reader is None else (self.reader.profile,)))
        slowest_hz: float = min(each.profile.max_rate_hz for each in devices)
        return max(_TIMEOUT_S, _TIMEOUT_PERIODS / slowest_hz)

    @property
    def watchdog_timeout_s(self) -> float | None:
        """Timeout of the watchdog, s; None without one."""
        return None if self.watchdog == "none" else self.watchdog.timeout_s

    @property
    def safe_command(self) -> float:
        """Output after a trip of the watchdog, as a command; 0 without one."""
        return 0.0 if self.watchdog == "none" else self.watchdog.safe_command

    @property
    def calibration_file(self) -> NamedCalibration | None:
        """The calibration to apply."""
        return self.calibration if isinstance(self.calibration, NamedCalibration) else None


class SignalChain:
    """Conversion of commands to output values and of input values to displacements.

    The units must match; without an amplifier an output in A drives the coil itself.
    """

    def __init__(
        self,
        output: Range,
        sensor_input: Range,
        amplifier: Amplifier | None,
        sensor: Sensor,
        calibrated: AmplifierCalibration | None = None,
    ) -> None:
        if amplifier is None and output.unit != "A":
            raise InputError(f"amplifier is required: the output is in {output.unit}")
        if amplifier is not None and amplifier.output_unit != output.unit:
            raise InputError(
                f"amplifier takes {amplifier.output_unit}, but the output is in {output.unit}"
            )
        self.amplifier, self.sensor, self.input = amplifier, sensor, sensor_input
        self.command_unit: CommandUnit = "A" if amplifier is None else amplifier.command_unit
        self._output_unit = output.unit
        self._gain = 1.0 if amplifier is None else amplifier.gain
        self._offset = 0.0 if amplifier is None else amplifier.offset
        self._measured = self._gain, self._offset
        if calibrated is not None:
            if calibrated.unit != self.command_unit:
                rule = f"calibration: amplifier.unit must be {self.command_unit}"
                raise InputError(f"{rule}, got {calibrated.unit}")
            self._gain *= calibrated.gain
            self._offset = self._offset * calibrated.gain + calibrated.offset
        self._um_per_unit = sensor.um_per_unit(sensor_input)
        self._offset_um = sensor.offset_um
        self.command_range = sorted(map(self.command, output.limits))
        """Lowest and highest command of the output's range."""
        self.command_step = abs(self._gain) * output.step
        """Smallest step of a command."""
        self.displacement_range = sorted(map(self.displacement_um, sensor_input.limits))
        """Lowest and highest displacement of the input's range, um."""

    @property
    def factors(self) -> tuple[float, float, float, float]:
        """Gain and offset of the command, sensitivity and offset of the displacement."""
        return self._gain, self._offset, self._um_per_unit, self._offset_um

    def output(self, command: _Value) -> _Value:
        """Return the output value of a command, or of a block of them."""
        return (command - self._offset) / self._gain

    def command(self, output: _Value) -> _Value:
        """Return the command of an output value, or of a block of them."""
        return output * self._gain + self._offset

    def displacement_um(self, value: float) -> float:
        """Return the displacement of an input value, um."""
        return value * self._um_per_unit + self._offset_um

    def measured(self, source: Range) -> tuple[float, float]:
        """Return gain and offset of the command as measured by an input, in its unit.

        Raise InputError if the input is in the unit of neither the output nor the command.
        """
        if source.unit == self._output_unit:
            return self._measured  # a calibration is relative to what is measured
        gain = source.per_unit(self.command_unit)
        if gain is None:
            units = " or ".join(dict.fromkeys((self._output_unit, self.command_unit)))
            raise InputError(f"measure must be in {units}, got one in {source.unit}")
        return gain, 0.0

    def fill_um(self, values: F64, displacement_um: F64) -> None:
        """Fill in the displacements of a block of input values, um."""
        np.multiply(values, self._um_per_unit, out=displacement_um)
        displacement_um += self._offset_um


def channel(what: str, name: str, channels: Mapping[str, _Channel], title: str) -> _Channel:
    """Return an output or input by its name.

    Args:
        what: The option that names it.
        name: Its name.
        channels: Outputs or inputs of the device.
        title: The device.

    Raises:
        InputError: There is none, or it is an input that measures the device's own output.
    """
    if name not in channels:
        known = ", ".join(channels) or "none"
        raise InputError(f"{what} must be one that {title} has, got {name!r} (it has {known})")
    found = channels[name]
    if getattr(found, "measures", "terminal") != "terminal":
        raise InputError(
            f"input {name} of {title} measures the device's own output: name the device that reads "
            "the sensor as reader"
        )
    return found


def measuring_input(
    name: str | None, inputs: Mapping[str, _Channel], title: str
) -> _Channel | None:
    """Return the input of that name, which must measure the output itself; None without a name."""
    if name is None:
        return None
    measuring = {
        key: each for key, each in inputs.items() if getattr(each, "measures", "") == "output"
    }
    if name not in measuring:
        known = ", ".join(measuring) or "none"
        rule = f"measure must be an input of {title} that measures its own output"
        raise InputError(f"{rule}, got {name!r} (it has {known})")
    return measuring[name]


def check_watchdog(
    title: str,
    options: DacOptions,
    output: Range,
    chain: SignalChain,
    has: Watchdog | Literal["none"],
) -> None:
    """Reject watchdog options that do not match the watchdog that the device ``has``.

    Raises:
        InputError: It has none, cannot take the timeout, or would not go to the safe command.
    """
    wanted, name = options.watchdog, options.output
    if wanted == "none":
        return
    if has == "none":
        raise InputError(
            f"{title} has no host watchdog: it holds its last output when this "
            "machine fails; set watchdog: none to accept that"
        )
    has.counts(wanted.timeout_s)
    low, high = chain.command_range
    if not low <= wanted.safe_command <= high:
        raise InputError(
            f"watchdog.safe_command must be {low:g} to {high:g}, got {wanted.safe_command:g}"
        )
    _check_trip(title, name, output, chain, has, wanted.safe_command)


def _check_trip(
    title: str, name: str, output: Range, chain: SignalChain, has: Watchdog, safe_command: float
) -> None:
    """Reject a watchdog that would not set an output to the safe command."""
    safe = getattr(has, "safe", {})
    if has.on_trip == "hold":
        raise InputError(
            f"the watchdog of {title} holds the value of {name} when it trips: set watchdog: none "
            "to accept that"
        )
    if has.on_trip == "safe" and safe and name not in safe:
        raise InputError(
            f"the watchdog of {title} does not act on {name}, only on "
            f"{', '.join(safe)}: use one of these, or set watchdog: none"
        )
    at_zero, unit = chain.command(0.0), chain.command_unit
    if has.on_trip in {"zero", "reset"} and abs(at_zero - safe_command) > 1e-9:
        raise InputError(
            f"the watchdog of {title} sets {name} to 0 {output.unit}, which is {at_zero:g} "
            f"{unit} here: set watchdog.safe_command to {at_zero:g}, got {safe_command:g}"
        )
