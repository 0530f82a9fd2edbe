"""Parts of a :class:`~hilctl_drivers.dac.Dac` that depend on the protocol: wire and watchdog.

Values are in the unit of the output or input, commands in the unit of the actuator. Errors are
``DeviceError`` and name neither the device nor the action: the device adds them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.session import SensorReader, Session
from hilctl_drivers.transport.links import CorruptError
from hilctl_drivers.transport.wire_time import RateLimit


class HostWatchdog(ABC):
    """The watchdog of the device, with the settings of the experiment."""

    arm_s = 0.0
    """Longest time to arm it."""

    @abstractmethod
    def recover(self) -> None:
        """End a trip of an earlier run, after which the device accepts its init steps."""

    @abstractmethod
    def arm(self) -> None:
        """Arm it; called only if the experiment sets a watchdog."""

    @abstractmethod
    def disarm(self) -> None:
        """Disarm it; called only if the experiment sets a watchdog."""

    def feed(self) -> None:  # noqa: B027  most watchdogs are fed by each exchange
        """Feed a watchdog that exchanges do not feed."""

    @abstractmethod
    def tripped(self) -> bool:
        """Return whether it has tripped; False if unknown."""


class Wire(ABC):
    """Path to the output of a device; each protocol has one, streaming devices have another.

    It describes itself in attributes and opens nothing before :meth:`open`.

    Args:
        setup: The options and profiles; raise InputError for an option that is not supported.
        link: The link to the device with the output.
    """

    session: Session
    watchdog: HostWatchdog
    block_max = 1  # samples of one exchange
    block_note = ""  # reason for that limit, in messages
    fifo_depth = 0  # samples; 0 if a sample is exchanged per message, at the host's pace
    verb = "write {output}, read {input}"  # an exchange in messages
    reads_output = True  # whether the output can be read before a run
    unconfirmed = ""  # why a written value cannot be confirmed; empty if it can
    longest_message_s = 0.0  # longest delay of the safe value by a running exchange
    requests = 1  # requests of an exchange, known after :meth:`start`

    def __init__(self, setup: DacSetup, link: Any) -> None:
        self.setup = setup
        self.link = link
        self.aux: F64 = np.full(len(setup.aux), np.nan)
        """Newest values of the auxiliary channels."""

        self.aux_in_turn: Sequence[int] = range(len(setup.aux))
        """Auxiliary channels that need requests of their own, known after :meth:`start`."""
        self.read_measured: Callable[[], float] | None = None
        """Returns the measured output after an exchange, known after :meth:`start`; None if that
        needs a request of its own."""

    @abstractmethod
    def rates(self, block: int) -> RateLimit:
        """Return the sample rates that it can keep with this block."""

    def joint(self, wires: "Sequence[Wire]") -> "JointWire | None":
        """Return the joint exchange of wires on one link to one device; None without one."""
        return None

    def open(self, block_s: float = 0.0) -> list[str]:
        """Connect, identify the device, and return errors of earlier sessions.

        An answer may take ``block_s`` longer than the timeout, if the device's clock sets the pace.
        """
        with self.opened():
            self.session.identify()
            return self.session.old_errors()

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Open the link; a device that boots may send text in place of its first replies."""
        if not self.link.is_open:  # another output may have opened it
            self.link.open()
        hint = getattr(self.link, "boot_hint", "")
        try:
            yield
        except CorruptError as error:
            raise CorruptError(f"{error}{hint}") from None

    def recover(self) -> None:
        """Clean up after an earlier run, so that the device accepts its init steps."""
        self.watchdog.recover()

    @abstractmethod
    def start(self, reader: SensorReader, sample_rate_hz: float, block: int) -> None:
        """Prepare the exchange, and test the message of the safe value; nothing moves.

        ``reader`` reads the sensor in each exchange, unless the reply brings the reading.
        """

    @abstractmethod
    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """Send a block and fill in the displacements; with a FIFO, :attr:`aux` too.

        Sizes and range are good, see :meth:`hilctl.base.device.Device.exchange`.
        """

    @abstractmethod
    def read(self) -> float | None:
        """Return the output; None if unknown."""

    @abstractmethod
    def look(self, reader: SensorReader) -> tuple[float, float | None]:
        """Return the value of the input, and of the output if it is known; change nothing."""

    @abstractmethod
    def message(self, value: float) -> bytes:
        """Return the message that sets the output, as sent on a serial line."""

    @abstractmethod
    def confirm(self, value: float) -> None:
        """Set the output.

        Raises:
            UnconfirmedError: It was sent, but the device cannot confirm it.
            DeviceError: The device did not confirm it.
        """

    def disarm(self) -> None:
        """End the exchange, and disarm the watchdog; the output stays."""
        if self.setup.options.watchdog != "none":
            self.watchdog.disarm()

    def close(self) -> None:
        """Disarm and run the close steps; the output stays."""
        # First: nothing feeds it any more, and it would trip while the close steps run.
        self.disarm()
        self.session.finish()

    def release(self) -> None:
        """Close the link, if open, without a message to the device."""
        self.link.close()


class JointWire(ABC):
    """Exchange of several outputs of one device; its wires do the rest."""

    requests = 1
    """Requests of an exchange, known after :meth:`start`."""

    def __init__(self, wires: Sequence[Wire]) -> None:
        self.wires = wires

    @abstractmethod
    def rates(self, block: int) -> RateLimit:
        """See :meth:`Wire.rates`."""

    @abstractmethod
    def start(self, readers: Sequence[SensorReader], sample_rate_hz: float, block: int) -> None:
        """Prepare the exchange after each wire has started; there is a reader per wire."""

    @abstractmethod
    def exchange(
        self, first_sample: int, commands: Sequence[F64], displacements_um: Sequence[F64]
    ) -> None:
        """See :meth:`Wire.exchange`; there is a block per wire."""

    def release(self) -> None:  # noqa: B027  most have nothing to forget
        """Forget what :meth:`start` has found."""
