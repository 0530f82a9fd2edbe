"""What a protocol must do to stand behind ``serial_dac``."""

from abc import ABC, abstractmethod

from hilctl.base.arrays import F64
from hilctl.base.errors import InputError
from hilctl_drivers.serial.setup import SerialSetup
from hilctl_drivers.wire.timing import RateLimit


class SerialWire(ABC):
    """How one kind of device is talked to; values are in the units of its channels.

    Attributes:
        block_max: Most samples of one exchange.
        fifo_depth: Samples that its FIFO holds; 0 where it has none.
        measures: Whether :meth:`exchange` fills ``measured``.

    Args:
        setup: What the experiment says of it.

    Raises:
        InputError: Options that this protocol has no use for.
    """

    block_max = 1
    fifo_depth = 0
    measures = False

    def __init__(self, setup: SerialSetup) -> None:
        self._setup = setup

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
    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """Send float64[B], fill ``reading`` (float64[B]), see :class:`~hilctl.base.device.Device`.

        ``measured``, float64[B] in the output's unit, is filled where :attr:`measures` says so.

        Raises:
            DeviceError: No good answer in time.
        """

    @abstractmethod
    def put_out(self, value: float) -> None:
        """Put ``value`` out at once, by the open link or by a new one; tried twice.

        Raises:
            DeviceError: The device can't be reached or does not confirm.
        """

    @abstractmethod
    def close(self) -> None:
        """Disarm and carry out the close steps; :meth:`release` follows.

        Raises:
            DeviceError: The device did not confirm.
        """

    @abstractmethod
    def release(self) -> None:
        """Let go of the port and say nothing to the device."""


def refuse(setup: SerialSetup, *names: str) -> None:
    """Refuse options that only devices that speak lines of text have.

    Raises:
        InputError: One of them is given.
    """
    for name in names:
        if getattr(setup.options, name) is not None:
            raise InputError(f"{name} is for devices that speak lines of text")
