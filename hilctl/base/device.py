"""The contracts of a device and of a clock.

Devices implement :class:`Device` in ``hilctl_drivers`` or in other packages;
:mod:`hilctl.loop.pacer` and the tests implement clocks.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias, runtime_checkable

from hilctl.base.calibration import NamedCalibration
from hilctl.base.errors import InputError
from hilctl.base.samples import RECORDED_FIELDS
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64, CommandUnit


class DeviceOptions(StrictModel):
    """Base of a device's own options in the experiment file: frozen, strict, no unknown keys."""


class VoltageLimit(DeviceOptions):
    """Largest voltage u of an amplifier that drives a coil: u = R i + L di/dt.

    The voltages that moving rods induce are omitted.
    """

    voltage_max_v: float = Field(gt=0.0, le=1e3, description="largest voltage either way, V")
    resistance_ohm: float = Field(gt=0.0, le=1e3, description="resistance of the coil, ohm")
    inductance_h: float = Field(gt=0.0, le=10.0, description="inductance of the coil, H")
    bandwidth_hz: float | None = Field(
        default=None, ge=1.0, le=1e6, description="corner of the first-order current loop, Hz"
    )

    @property
    def held_a(self) -> float:
        """Current that the largest voltage holds, in A."""
        return self.voltage_max_v / self.resistance_ohm

    def decay(self, seconds: float) -> float:
        """Return the remaining fraction of an undriven current."""
        return math.exp(-self.resistance_ohm / self.inductance_h * seconds)

    def voltage_v(self, current_a: F64, period_s: float) -> F64:
        """Return the constant voltage that moves a current in one period, in V.

        ``current_a`` is float64[n + 1]; float64[n] is returned, from each current to the next.
        """
        moved = -math.expm1(-self.resistance_ohm / self.inductance_h * period_s)
        before = current_a[:-1]
        return self.resistance_ohm * (before + (current_a[1:] - before) / moved)


_TAKEN = {"sample", "t_s", "flags", *(each.name for each in RECORDED_FIELDS)}


def limited_range(limits: object) -> tuple[float, float] | None:
    """Return the range of the drive, A or V, from a ``limits`` section that is not validated yet.

    None if the range is missing or invalid.
    """
    match limits:
        case {"peak_current_a": int() | float() as high} if high > 0.0:
            return -high, high
        case {"drive_a": (int() | float() as low, int() | float() as high)} | {
            "drive_v": (int() | float() as low, int() | float() as high)
        } if low < high:
            return low, high  # fmt: skip
    return None


@dataclass(frozen=True, slots=True)
class AuxChannel:
    """An auxiliary channel: another input of the device, such as a temperature.

    Attributes:
        name: Key under ``limits.aux`` and column of the recording; with its unit, ``coil_c``.
        unit: Unit as text; may be empty.
        meaning: One line of text; may be empty.
    """

    name: str
    unit: str = ""
    meaning: str = ""

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or self.name in _TAKEN:
            rule = "must consist of letters, digits and '_', and not be a column of recordings"
            raise InputError(f"aux.{self.name}: the name {rule}")


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Properties of a device, known before anything moves.

    Attributes:
        name: Registry name, for example ``simulated_terfenol``.
        description: One line of text.
        command_unit: Unit of the commands it takes.
        command_min: Lowest command it accepts, in ``command_unit``.
        command_max: Highest command it accepts, in ``command_unit``.
        command_step: Smallest step of its output, in ``command_unit``; 0 if unknown.
        sensor_min_um: Lowest displacement its sensor can report.
        sensor_max_um: Highest displacement its sensor can report.
        max_rate_hz: Highest sample rate it can keep.
        rate_note: Reason for ``max_rate_hz`` in words; may be empty.
        buffered: Whether it has its own sample clock and FIFO. Then the sample index is the time
            base and a late tick costs FIFO depth; otherwise the host's clock paces it.
        fifo_depth: Capacity of its FIFO in samples; 0 without one.
        latency_blocks: Exchanges from sending a block to receiving its displacements. 0 for the
            same exchange; more for a device that plays blocks from a FIFO and sets the pace:
            :meth:`Device.exchange` then waits for its clock.
        measures_command: Whether :meth:`Device.exchange` fills ``measured``.
        reads_output: Whether :meth:`Device.output` returns the output. False if it always returns
            None; then a run needs ``safe.at_start``.
        ages_readings: Whether the device is an :class:`AgingDevice`: its sensor sends unasked.
        holds: Resources that it uses exclusively while open, with a name common to all devices
            (``serial:/dev/ttyUSB0``, ``tcp:10.0.0.5:502``). Empty for a device without such a
            resource.
        identity: Names that identify the last run of the output's device: those in ``holds``, the
            most stable first, and the serial number of its USB adapter, prefixed by ``usb:``. If
            two devices have such a number, only these are compared. Empty: ``holds``.
        output: Name of the output among those of the device; empty if there is one.
        simulated: Whether it drives no hardware and steps on sample count, so that it may run
            faster than real time.
        watchdog_command: Output set by the device's watchdog when the host is silent, in
            ``command_unit``; None without a watchdog.
        watchdog_timeout_s: Silence after which the watchdog trips; None without one.
        arm_s: Longest communication time of :meth:`WatchdogDevice.arm`; 0 without a watchdog.
        watchdog_reason: Reason for a watchdog value other than the safe value; may be empty.
        safe_note: Limitation of the safe value in words: its message takes longer than 0.2 s, or
            the device cannot confirm it; may be empty.
        confirms: Whether an answer of the device confirms the command that it answers.
        details: Facts for the recording (serial numbers, physical parameters). Opening may add some
            (``transactions``: requests per tick).
        files: YAML texts for the recording by file name, such as ``profile.yaml``.
        calibration: Calibration of sensor and amplifier. With a calibrated sensor, ``reading_um``
            of the device holds the uncorrected readings of the last exchange.
        aux: Auxiliary channels. If there are any, ``aux`` of the device holds their newest values
            after an exchange: float64[len(aux)], NaN if missing.
        digital_output: Name of the digital output for triggers; empty without one. With a digital
            output or input the device is a :class:`DigitalDevice`.
        digital_output_s: Time to set it, in s; part of ``max_rate_hz``.
        digital_input: Name of the digital input for triggers; empty without one.
    """

    name: str
    description: str
    command_unit: CommandUnit
    command_min: float
    command_max: float
    sensor_min_um: float
    sensor_max_um: float
    max_rate_hz: float
    rate_note: str = ""
    command_step: float = 0.0
    buffered: bool = False
    fifo_depth: int = 0
    latency_blocks: int = 0
    measures_command: bool = False
    reads_output: bool = True
    ages_readings: bool = False
    holds: tuple[str, ...] = ()
    identity: tuple[str, ...] = ()
    output: str = ""
    simulated: bool = False
    watchdog_command: float | None = None
    watchdog_timeout_s: float | None = None
    arm_s: float = 0.0
    watchdog_reason: str = ""
    safe_note: str = ""
    confirms: bool = True
    details: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    calibration: NamedCalibration | None = None
    aux: tuple[AuxChannel, ...] = ()
    digital_output: str = ""
    digital_output_s: float = 0.0
    digital_input: str = ""

    @property
    def corrects_readings(self) -> bool:
        """Whether displacements are readings corrected by the calibration of the sensor."""
        return self.calibration is not None and self.calibration.content.sensor is not None


REQUIRED = ("info", "open", "exchange", "make_safe", "close")
"""Required members of a device."""
OPTIONAL = ("output", "check_rate")
"""Optional methods with a default in :class:`Device`."""


def complete(device: Any) -> "Device":
    """Return a device with defaults for missing optional methods.

    Its class need not derive from :class:`Device`.

    Raises:
        InputError: Required members are missing; all are named.
    """
    kind = type(device)
    missing = [
        name
        for name in REQUIRED
        if not hasattr(device, name) or getattr(kind, name, None) is getattr(Device, name)
    ]
    if missing:
        raise InputError(f"{kind.__name__} lacks {', '.join(missing)} (see drivers/README.md)")
    for name in OPTIONAL:
        if not hasattr(device, name):
            setattr(kind, name, getattr(Device, name))
    found: Device = device
    return found


class Device(Protocol):
    """A DAC with its amplifier, the actuator and the sensor as one device.

    A device rejects an impossible command with :class:`~hilctl.base.errors.DeviceError`; it never
    clips, wraps or rounds it into range.
    """

    Options: ClassVar[type[DeviceOptions]]

    def __init__(self, options: Any) -> None:
        """Store options, an instance of :attr:`Options`, without any I/O."""
        ...

    @property
    def info(self) -> DeviceInfo:
        """Properties of the device; constant and available before :meth:`open`."""
        ...

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        """Reject a rate that the device cannot keep with this block; no I/O. Optional.

        Raises:
            DeviceError: The rate is too high, or too low.
        """

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, verify the device, and prepare the exchange.

        Must not move the output.

        Raises:
            DeviceError: It cannot be reached, or does not support this rate or block.
        """
        ...

    def output(self) -> float | None:
        """Return the output of the open device before the first exchange.

        Optional. The run begins with a ramp from there, so the value must be read back, not
        guessed; None (the default) if the device cannot report it.

        Raises:
            DeviceError: It did not answer, or is not open.
        """
        return None

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Send one block of commands and read one block of displacements.

        ``displacement_um[j]`` is sampled when ``command[j]`` is output, so it does not show the
        effect of that command. If ``info.latency_blocks`` is more than 0, displacements and
        measured commands are those of the block sent that many exchanges before; the first
        exchanges leave them unchanged.

        Args:
            first_sample: Index of the block's first sample since the start of the run. A jump
                means that samples in between were skipped; the output held its last value.
            command: float64[block], in ``info.command_unit``; not modified.
            displacement_um: float64[block], filled by the call; NaN is an invalid reading.
            measured: float64[block], the command as measured by the device, filled by the call
                if ``info.measures_command``; unchanged otherwise.

        Raises:
            DeviceError: A command is out of range or not finite (then nothing was sent), the
                device did not answer in time or answered wrongly, or it is not open.
        """
        ...

    def make_safe(self, command: float) -> None:
        """Set the output to ``command`` in one attempt, and return if the device confirms it.

        Connect if necessary, write, await the confirmation, and disconnect. The attempt is bounded
        by the device's timeouts: it does not retry or wait for older commands, sends no self-test
        or init step, and accepts any command in range. The caller retries until the value is
        confirmed, repeats the write while an older, unanswered command may still be executed, and
        ramps with successive values.

        On a serial line the value is sent before any wait. The answer to an older command is never
        taken as the confirmation.

        Raises:
            UnconfirmedError: The command was sent, but the device cannot confirm it, not even in
                another attempt.
            DeviceError: The device cannot be reached, rejected the command, or did not confirm in
                time.
        """
        ...

    def close(self) -> None:
        """Release the port and leave the output unchanged. May be called twice."""
        ...


@runtime_checkable
class WatchdogDevice(Protocol):
    """A device with a watchdog."""

    def arm(self) -> None:
        """Arm the device's watchdog, if the experiment enables it.

        Called once after the start signal, immediately before the first exchange, because the run
        may wait to start after :meth:`Device.open`. Must not move the output.

        Raises:
            DeviceError: The device did not confirm, or is not open.
        """
        ...


class DeviceReadings(NamedTuple):
    """Readings of a device without a run."""

    displacement_um: float
    output: float | None  # in the command's unit; None if unknown
    measured: float = math.nan  # command as measured by the device; NaN if it is not measured
    tripped: bool = False  # whether the device's watchdog has tripped, if that can be read


@runtime_checkable
class ReadableDevice(Protocol):
    """A device that can be read without opening it."""

    def look(self) -> DeviceReadings | tuple[float, float | None]:
        """Connect, return the readings, and disconnect without changing anything.

        Raises:
            DeviceError: The device is open, cannot be reached, is another device, or answers
                wrongly.
        """
        ...


class JointDevice(Protocol):
    """Devices that share hardware, exchanged at once.

    It opens and closes all of them. While it is open, the other methods of each device (``output``,
    ``arm``, ``make_safe``, ...) and its attributes work as if the device itself had been opened;
    :meth:`Device.make_safe` also works after :meth:`close`.

    Attributes:
        axes: Names of the axes of its devices, in the order of their blocks.
        max_rate_hz: Highest sample rate it can keep.
        rate_note: Reason for ``max_rate_hz`` in words; may be empty.
    """

    axes: Sequence[str]
    max_rate_hz: float
    rate_note: str

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        """Reject a rate that the devices cannot keep together; see :meth:`Device.check_rate`."""
        ...

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Open all devices; see :meth:`Device.open`. After an error none is open."""
        ...

    def exchange(
        self,
        first_sample: int,
        commands: Sequence[F64],
        displacements_um: Sequence[F64],
        measured: Sequence[F64],
    ) -> None:
        """Send a block of commands to each device and read its displacements at once.

        Each sequence holds a float64[block] per axis; see :meth:`Device.exchange`. If a command is
        invalid, nothing was sent to any device.

        Raises:
            DeviceError: A device rejected its commands or did not answer.
        """
        ...

    def close(self) -> None:
        """Close all devices and leave their outputs unchanged. May be called twice."""
        ...


@runtime_checkable
class JoinableDevice(Protocol):
    """A device that may share hardware with others."""

    def join(self, devices: "Mapping[str, Device]") -> JointDevice | None:
        """Return the joint exchange of this device and those that share its hardware; no I/O.

        Args:
            devices: Devices that are not open, by name of their axes: this one first. A device of
                another package is a proxy that has the same attributes.

        Returns:
            None if this device is exchanged on its own.
        """
        ...


Units: TypeAlias = Mapping[tuple[str, ...], Device | JointDevice]
"""What is opened, exchanged in turn, and closed, by the names of its axes."""


def joined(devices: Mapping[str, Device]) -> Units:
    """Return the units of a run: devices, and joint devices of those that share hardware."""
    left = dict(devices)
    units: dict[tuple[str, ...], Device | JointDevice] = {}
    while left:
        name, device = next(iter(left.items()))
        joint = None
        if len(left) > 1 and isinstance(device, JoinableDevice):
            joint = device.join(left)
        axes = (name,) if joint is None else tuple(joint.axes)
        units[axes] = device if joint is None else joint
        for each in axes:
            del left[each]
    return units


@runtime_checkable
class PortDevice(Protocol):
    """A device on a port whose path may lead to another device later.

    Attributes:
        port_identity: The device that the path led to first; empty if there was none. A process
            that starts later sets it, and then refuses to write to any other device.
    """

    port_identity: str


class DigitalDevice(Protocol):
    """A device with digital channels for triggers.

    Opening it sets the output low.

    Attributes:
        safe_command: The safe value. After a write of it, :meth:`Device.make_safe` also sets the
            output low, in one attempt whose failure is ignored. NaN: unknown.
    """

    safe_command: float

    def set_digital(self, high: bool) -> None:
        """Set the digital output, and await the answer; raise DeviceError as an exchange does."""
        ...

    def read_digital(self) -> bool:
        """Return whether the digital input is high; raise DeviceError as an exchange does."""
        ...


class AgingDevice(Protocol):
    """A device whose sensor sends unasked, so that a reading is older than the exchange."""

    @property
    def reading_age_s(self) -> float:
        """Age of the last exchange's displacement; NaN if none has arrived yet."""
        ...

    @property
    def lost_readings(self) -> int:
        """Readings since :meth:`WatchdogDevice.arm` that did not arrive."""
        ...


class Clock(Protocol):
    """Monotonic time in nanoseconds."""

    def now_ns(self) -> int:
        """Return the time in ns; never goes back."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``; return immediately if that is past."""
        ...
