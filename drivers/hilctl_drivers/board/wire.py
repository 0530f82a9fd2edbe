"""A microcontroller board asked sample by sample, and what its streaming form shares with it."""

from typing import Protocol

from hilctl.base.arrays import F64
from hilctl.base.errors import DeviceError
from hilctl_drivers.board import frames as board
from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.board.session import BoardFacts, BoardSession
from hilctl_drivers.feed_time import check_feeds
from hilctl_drivers.serial.setup import SerialSetup
from hilctl_drivers.wire.errors import WatchdogTripped
from hilctl_drivers.wire.links import Link, LostError


class Wire(Protocol):
    """How one kind of device is talked to; values are in the units of its channels."""

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check and set up; the output does not move.

        Raises:
            DeviceError: It can't be reached, is another device, or can't keep this rate or block.
        """
        ...

    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """Send float64[B], fill ``reading`` (float64[B]), see :class:`~hilctl.base.device.Device`.

        ``measured``, float64[B] in the output's unit, is filled where the setup has ``measure``.

        Raises:
            DeviceError: No good answer in time.
        """
        ...

    def put_out(self, value: float) -> None:
        """Put ``value`` out at once, by the open link or by a new one; tried twice.

        Raises:
            DeviceError: The device can't be reached or does not confirm.
        """
        ...

    def close(self) -> None:
        """Disarm, carry out the close steps and let go of the port.

        Raises:
            DeviceError: The device did not confirm; the port is let go all the same.
        """
        ...

    def release(self) -> None:
        """Let go of the port and say nothing to the device."""
        ...


class BoardWire:
    """What both forms of a board share.

    Args:
        setup: What the experiment says of it.
        profile: What the board is.
    """

    def __init__(self, setup: SerialSetup, profile: FrameProfile) -> None:
        self._setup = setup
        self._profile = profile
        self._session = BoardSession(profile, setup.link())

    def put_out(self, value: float) -> None:
        """See :meth:`Wire.put_out`; a board that has gone to its safe value is told again."""
        try:
            self._put_out(value)
        except LostError:
            self._session.link.open()  # a replugged adapter is a new port
            self._put_out(value)
        except DeviceError:
            self._put_out(value)  # a late or damaged answer must not cost the safe value

    def _put_out(self, value: float) -> None:
        try:
            self._session.put_out(value)
        except WatchdogTripped:
            self._arm()
            self._session.put_out(value)

    def release(self) -> None:
        """See :meth:`Wire.release`."""
        self._session.link.close()

    def _connect(self, link: Link) -> BoardFacts:
        """Connect and check that it is a board that this profile describes."""
        self._session = BoardSession(self._profile, link)
        link.open()
        facts = self._session.facts()
        if facts.version != board.VERSION:
            raise DeviceError(
                f"{facts.name or 'the board'} speaks version {facts.version} of the protocol, "
                f"not {board.VERSION}"
            )
        low, high = self._setup.output_range
        slack = 1e-6 * (high - low)
        if low < facts.low - slack or high > facts.high + slack:
            raise DeviceError(
                f"{facts.name or 'the board'} puts out {facts.low:g} to {facts.high:g}, the "
                f"profile says {low:g} to {high:g}"
            )
        return facts

    def _arm(self) -> None:
        """Set the watchdog as the experiment wants it, and clear a trip of an earlier run."""
        if self._profile.watchdog != "none":
            timeout_s = self._setup.watchdog_timeout_s or 0.0
            self._session.set_watchdog(timeout_s, self._setup.safe_output)

    def _disarm(self) -> None:
        if self._profile.watchdog != "none":
            self._session.set_watchdog(0.0, self._setup.safe_output)


class BoardSingle(BoardWire):
    """A :class:`Wire` to a board that takes one sample a message, paced by this machine."""

    def open(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`Wire.open`."""
        if block != 1:
            raise DeviceError(f"block must be 1 for a board without a FIFO, got {block}")
        check_feeds(self._setup.watchdog_timeout_s, sample_rate_hz)
        self._connect(self._setup.link())
        self._arm()

    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """See :meth:`Wire.exchange`."""
        del first_sample, measured
        found = self._session.exchange(output)
        if found.values.size != 1:
            raise DeviceError(f"{found.values.size} readings came for one sample")
        reading[:] = found.values

    def close(self) -> None:
        """See :meth:`Wire.close`."""
        try:
            self._disarm()
        finally:
            self.release()
