"""What a protocol must do to stand behind ``serial_dac``."""

from abc import ABC, abstractmethod

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.profile_base import Range
from hilctl_drivers.serial.serial_setup import SerialSetup
from hilctl_drivers.transport.safe_exchange import SafeExchange
from hilctl_drivers.transport.wire_time import RateLimit


class SerialWire(ABC):
    """How one kind of device is talked to; values are in the units of its channels.

    Attributes:
        block_max: Most samples of one exchange.
        fifo_depth: Samples that its FIFO holds; 0 where it has none.
        measures: Whether :meth:`exchange` fills ``measured``.
        longest_message_s: Longest until the safe value is there, after an exchange that is under
            way; 0 where that is too short to be worth a word.
        arm_s: Longest that :meth:`arm` takes on the wire.
        unconfirmed: Why a value that was written cannot be confirmed, in words; empty if it can.

    Args:
        setup: What the experiment says of it.

    Raises:
        InputError: Options that this protocol has no use for.
    """

    block_max = 1
    fifo_depth = 0
    measures = False
    longest_message_s = 0.0
    unconfirmed = ""
    arm_s = 0.0

    def __init__(self, setup: SerialSetup) -> None:
        self._setup = setup
        self._link = setup.link()
        self._safe_exchange = SafeExchange()

    @abstractmethod
    def rates(self, block: int) -> RateLimit:
        """Return the sample rates that wire and device leave with this block."""

    @abstractmethod
    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check and set up; the output does not move.

        Raises:
            DeviceError: It can't be reached, is another device, or can't keep this rate or block.
        """

    @abstractmethod
    def arm(self) -> None:
        """Arm the watchdog, if the experiment wants it; the output does not move.

        Raises:
            DeviceError: The device did not confirm.
        """

    @abstractmethod
    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """Send float64[B], fill ``reading`` (float64[B]), see :class:`~hilctl.base.device.Device`.

        ``measured``, float64[B] in the output's unit, is filled where :attr:`measures` says so.

        Raises:
            DeviceError: No good answer in time.
        """

    def put_out(self, value: float) -> None:
        """Put ``value`` out at once in one attempt, by the open link or by a new one.

        Raises:
            UnconfirmedError: It was sent, and nothing that the device answers would confirm it.
            DeviceError: It was not confirmed.
        """
        self._safe_exchange.attempt(
            self._link, lambda: self._send(value), lambda: self._put_out(value)
        )

    def doubt(self) -> None:
        """Take no later answer for that to a message which failed."""
        self._link.doubt()

    @abstractmethod
    def output(self) -> float | None:
        """Return what the open device puts out, in the output's unit; None where it can't tell.

        Raises:
            DeviceError: No good answer in time.
        """

    @abstractmethod
    def look(self) -> tuple[float, float | None]:
        """Connect and return the input's value and the output's, None where it can't be known.

        Nothing is sent that changes anything: no steps of the profile, no watchdog, no clearing of
        a trip. :meth:`release` follows.

        Raises:
            DeviceError: It can't be reached, is another device, or gives no good answer.
        """

    @abstractmethod
    def _send(self, value: float) -> None:
        """Send ``value`` to the output and await no answer."""

    @abstractmethod
    def _put_out(self, value: float) -> None:
        """Put ``value`` out, and raise unless the device confirms it."""

    @abstractmethod
    def close(self) -> None:
        """Disarm and carry out the close steps; :meth:`release` follows.

        Raises:
            DeviceError: The device did not confirm.
        """

    @abstractmethod
    def release(self) -> None:
        """Let go of the port and say nothing to the device."""


def check_stands(output: Range, wanted: float, found: float) -> None:
    """Refuse what was read back where it is not what was written, to two steps of the output.

    Args:
        output: The output.
        wanted: What was written, in its unit.
        found: What was read back.

    Raises:
        DeviceError: It is another value.
    """
    step = 2.0 * (output.resolution or 1e-3 * (output.max - output.min))
    if not abs(found - wanted) <= step:
        raise DeviceError(f"{wanted:g} {output.unit} was written, {found:g} stands")


def refuse(setup: SerialSetup, *names: str) -> None:
    """Refuse options that only devices that speak lines of text have.

    Raises:
        InputError: One of them is given.
    """
    for name in names:
        if getattr(setup.options, name) is not None:
            raise InputError(f"{name} is for devices that speak lines of text")
