"""What the loop needs from the world: a device to drive and a clock to keep time by.

Only contracts live here. Devices implement :class:`Device` in ``hilctl_drivers`` or in other
people's packages; :mod:`hilctl.loop.pacer` and the tests supply clocks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

from hilctl.base.errors import InputError
from hilctl.base.strict import StrictModel
from hilctl.base.types import F64, CommandUnit


class DeviceOptions(StrictModel):
    """Base of a device's own options in the experiment file: frozen, strict, no unknown keys."""


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What a device says of itself before anything moves.

    Attributes:
        name: Registry name, for example ``simulated_terfenol``.
        description: One line for people.
        command_unit: Unit of the commands it takes.
        command_min: Lowest command it accepts, in ``command_unit``.
        command_max: Highest command it accepts, in ``command_unit``.
        sensor_min_um: Lowest displacement its sensor can report.
        sensor_max_um: Highest displacement its sensor can report.
        max_rate_hz: Highest sample rate it can keep.
        rate_note: Why ``max_rate_hz`` is what it is, in words; empty where there is no more to say.
        buffered: Whether it has a sample clock and a FIFO of its own. Then the sample index is
            the truth and a late tick costs FIFO depth; otherwise the host's clock paces it.
        fifo_depth: Samples its FIFO holds; 0 where it has none.
        latency_blocks: Exchanges from the one that sends a block to the one that brings its
            displacements. 0 where they are the same; more where blocks are played from a FIFO of
            the device, which then keeps the pace: :meth:`Device.exchange` waits for its clock.
        measures_command: Whether :meth:`Device.exchange` fills ``measured``.
        holds: What it holds alone while it is open, each by a name that is the same for every
            device that would hold it (``serial:/dev/ttyUSB0``, ``tcp:10.0.0.5:502``): one run at a
            time may hold it. Empty where any number may run side by side.
        simulated: Whether it drives no hardware and steps on sample count: it may run faster than
            real time, and its recordings say so.
        watchdog_command: Where the device's own watchdog puts the output when the host falls
            silent, in ``command_unit``; None where it has none, or is not to use it.
        watchdog_timeout_s: How long the host may be silent before it does; None without one.
        arm_s: How long :meth:`WatchdogDevice.arm` takes on the wire, at most; 0 without one.
        watchdog_reason: Why that is not the experiment's safe value; empty where it is.
        safe_note: What is wrong with the safe value of this device, in words: a message with it
            takes longer than 0.2 s, or the device cannot confirm it; empty if nothing is.
        confirms: Whether an answer of the device is evidence of the command that it answers.
        details: Anything worth keeping with a recording (serial numbers, physical parameters).
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
    buffered: bool = False
    fifo_depth: int = 0
    latency_blocks: int = 0
    measures_command: bool = False
    holds: tuple[str, ...] = ()
    simulated: bool = False
    watchdog_command: float | None = None
    watchdog_timeout_s: float | None = None
    arm_s: float = 0.0
    watchdog_reason: str = ""
    safe_note: str = ""
    confirms: bool = True
    details: Mapping[str, str] = field(default_factory=dict)


REQUIRED = ("info", "open", "exchange", "make_safe", "close")
"""What a device must have of its own."""
OPTIONAL = ("output",)
"""Methods that it may lack; it then has those of :class:`Device`."""


def complete(device: Any) -> "Device":
    """Return a device with the optional methods that it lacks.

    Its class need not have :class:`Device` as its base.

    Raises:
        InputError: It lacks what is required; all of it is named.
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
    """A DAC, its amplifier, the actuator and its sensor, seen as one thing.

    A device refuses what it can't do with :class:`~hilctl.base.errors.DeviceError`; it never clips,
    wraps or rounds a command into range.
    """

    Options: ClassVar[type[DeviceOptions]]

    def __init__(self, options: Any) -> None:
        """Take options, an instance of :attr:`Options`, and touch nothing outside."""
        ...

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts; constant and readable before :meth:`open`."""
        ...

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check that the device is what it should be, and get ready to exchange.

        Must not move the output.

        Args:
            sample_rate_hz: Samples a second.
            block: Samples in each exchange.

        Raises:
            DeviceError: It can't be reached, or can't keep this rate or block.
        """
        ...

    def output(self) -> float | None:
        """Return what the open device puts out, before the first exchange.

        Optional. Read back where that can be had. The run begins with a ramp from there, so a guess
        can do harm: None if the device can't know, as in the default.

        Raises:
            DeviceError: It did not answer, or is not open.
        """
        return None

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Send one block of commands and read one block of displacements.

        ``displacement_um[j]`` is sampled when ``command[j]`` is put out, so it can't yet show
        that command's effect. Where ``info.latency_blocks`` is more than 0, displacements and
        measured commands are those of the block sent that many exchanges before; the first ones,
        which answer no block, are left alone.

        Args:
            first_sample: Index of the block's first sample since the start of the run. A jump
                means that samples in between were skipped; the output held its last value.
            command: float64[block], in ``info.command_unit``; not modified.
            displacement_um: float64[block], filled by the call.
            measured: float64[block], the command as measured by the device, filled by the call
                if ``info.measures_command``; left alone otherwise.

        Raises:
            DeviceError: A command is out of range or not finite (then nothing was sent), the
                device did not answer in time or answered wrongly, or it is not open.
        """
        ...

    def make_safe(self, command: float) -> None:
        """Put the output at ``command`` in one attempt, and return if the device confirms it.

        Open a connection if there is none, write, have the device confirm, and let go. The attempt
        is bounded by the device's time-outs: it repeats nothing, waits for no older command and
        watches nothing. It sends no self-test and no init step, and takes any command in range:
        the caller retries until the value is confirmed, repeats the write while an older,
        unanswered command may still be executed, and ramps with successive values.

        On a serial line the value is sent before anything is waited for. The answer to an older
        command is never taken as the confirmation.

        Raises:
            UnconfirmedError: The command was sent, and nothing that the device can answer would be
                evidence of it. Repeating the attempt cannot confirm it.
            DeviceError: The device cannot be reached, refused, or did not confirm in time.
        """
        ...

    def close(self) -> None:
        """Let go of the port and leave the output as it is. Closing twice is fine."""
        ...


@runtime_checkable
class WatchdogDevice(Protocol):
    """A device with a watchdog of its own; devices without one need no :meth:`arm`."""

    def arm(self) -> None:
        """Arm the device's watchdog, if the experiment wants it.

        Called once after the start signal, immediately before the first exchange: armed at
        :meth:`Device.open`, it would count while the run waits to start. Must not move the output.

        Raises:
            DeviceError: The device did not confirm, or is not open.
        """
        ...


@runtime_checkable
class ReadableDevice(Protocol):
    """A device that can be read without being set up; devices need not be."""

    def look(self) -> tuple[float, float | None]:
        """Connect, return displacement and output as they are, and let go; nothing is changed.

        Returns:
            Displacement in um, and the output in the command's unit; None where it can't be known.

        Raises:
            DeviceError: Open; or it can't be reached, is another device, or gives no good answer.
        """
        ...


class Clock(Protocol):
    """Monotonic time in nanoseconds."""

    def now_ns(self) -> int:
        """Return the time in ns; never goes back."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``; return at once where that is past."""
        ...
