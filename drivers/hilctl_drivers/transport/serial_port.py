"""Serial port as a link."""

import array
import contextlib
import errno
import math
import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from os import read, write
from typing import Literal

import serial

from hilctl.base.errors import DeviceError
from hilctl.base.files import PORT_REMEDIES, reason
from hilctl_drivers.transport.links import LostError, Missing, NoAnswerError, cut, why
from hilctl_drivers.transport.resource_names import admit_others, refuse_to_others

_FIRST = 256
"""Most replies are shorter; see :mod:`hilctl_drivers.transport.tcp`."""
_CHUNK = 4096
_QUIET_S = 0.02


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Settings of a serial line.

    Attributes:
        gap_s: Silence to keep between a reply and the next request.
        boot_s: Wait after opening the port, for boards that reset then.
        flow: Flow control. With xonxoff, bytes 0x11 and 0x13 are signals and never data.
        dtr: Level to hold DTR at; None to raise it, as opening a port does.
        rts: Level to hold RTS at, likewise.
    """

    baud: int = 9600
    bytesize: Literal[7, 8] = 8
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    gap_s: float = 0.0
    boot_s: float = 0.0
    flow: Literal["none", "xonxoff"] = "none"
    dtr: bool | None = None
    rts: bool | None = None


def _open_port(path: str, settings: SerialSettings, timeout_s: float) -> serial.Serial:
    """Open and lock a port with all settings.

    Levels are set before opening. pyserial then applies them first, so a level that the system
    raised lasts for microseconds only.
    """
    port = serial.Serial(
        None,
        settings.baud,
        settings.bytesize,
        settings.parity,
        settings.stopbits,
        timeout=0.0,
        xonxoff=settings.flow == "xonxoff",
        write_timeout=timeout_s,
        exclusive=True,
    )
    if settings.dtr is not None:
        port.dtr = settings.dtr
    if settings.rts is not None:
        port.rts = settings.rts
    port.port = path
    port.open()
    if settings.boot_s > 0.0:
        try:
            _keep_levels(port.fileno())
        except OSError:
            port.close()
            raise
    return port


def _keep_levels(fd: int) -> None:
    """Keep DTR and RTS when the port is closed, or its process killed.

    A falling level, and the next opening of the port, reset some boards. Their output is then at
    the power-up value, and they do not answer to the safe value until they have booted.
    """
    import termios

    try:
        attributes = termios.tcgetattr(fd)
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
    except termios.error as error:
        raise OSError(*error.args) from None


def _counts_waiting(fd: int, waiting: "array.array[int]") -> Callable[[], object]:
    """Return a function that stores the number of received bytes in ``waiting[0]``."""
    # Only here: settings can be read and checked on computers that have neither.
    from fcntl import ioctl
    from termios import FIONREAD

    return partial(ioctl, fd, FIONREAD, waiting)


class SerialLink:
    """A serial port with exclusive access."""

    def __init__(
        self,
        port: str,
        settings: SerialSettings,
        timeout_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._path = port
        self._settings = settings
        self._gap_s = settings.gap_s
        self.timeout_s = timeout_s
        """Longest time of one exchange, s."""
        self._timeout_ms = math.ceil(timeout_s * 1e3)
        self._clock = clock
        self._sleep = sleep
        self._port: serial.Serial | None = None
        self._fd = -1
        self._poll = select.poll()
        self._waiting = array.array("i", [0])
        self._count_waiting: Callable[[], object] = lambda: None
        self._stale = True
        self._exclusive = False
        self._quiet_at = 0.0

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as is known."""
        return self._port is not None

    @property
    def is_in_step(self) -> bool:
        """Whether it is open, and no bytes of an older exchange can still come."""
        return self._port is not None and not self._stale

    def open(self, *, boot: bool = True) -> None:
        """Open and lock the port, see :meth:`~hilctl_drivers.transport.links.Link.open`.

        Received bytes are discarded.

        Args:
            boot: Whether to wait for a device that opening may have reset. Otherwise a port that
                this object closed in step is in step.
        """
        self.close()
        try:
            port = _open_port(self._path, self._settings, self.timeout_s)
        except (OSError, ValueError) as error:
            text = reason(error, PORT_REMEDIES) if isinstance(error, OSError) else str(error)
            raise LostError(f"can't be opened: {text}") from None
        # Otherwise an FTDI adapter holds bytes back for up to 16 ms; ptys and USB CDC refuse it.
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            port.set_low_latency_mode(True)
        self._port, self._fd = port, port.fileno()
        self._count_waiting = _counts_waiting(self._fd, self._waiting)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        if boot:
            self._exclusive = refuse_to_others(self._fd, self._path)
            self._stale = True
            self._sleep(self._settings.boot_s)
        self._quiet_at = self._clock()

    def transact(
        self, request: bytes | bytearray, missing: Missing, usual: int = 0
    ) -> bytes | bytearray:
        """Exchange, see :meth:`~hilctl_drivers.transport.links.Link.transact`.

        After a failure the next request waits until the line is quiet and discards what came:
        serial protocols do not number their replies, so a late one would pass for the next.
        """
        if self._port is None:
            raise LostError("not open")
        reply: bytes | bytearray
        try:
            if self._stale:
                self.drain()
            self._count_waiting()
            if self._waiting[0] or self._gap_s:
                self._await_gap()
            deadline = self._clock() + self.timeout_s
            # Past pyserial, which takes three times as long; its flush() hangs on ptys and USB CDC.
            try:
                sent = write(self._fd, request)
            except BlockingIOError:
                sent = 0
            if sent != len(request):
                self._port.write(request[sent:])
                usual = 0  # that took a part of the time-out
            if usual and self._poll.poll(self._timeout_ms):
                reply = read(self._fd, _FIRST)
                if len(reply) != usual:
                    reply = self._complete(bytearray(reply), missing, deadline)
            else:
                reply = self._complete(bytearray(), missing, deadline)
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None
        if self._gap_s:
            self._quiet_at = self._clock() + self._gap_s
        return reply

    def send_now(self, request: bytes | bytearray) -> None:
        """Send ``request`` whatever is on the line, and await no answer.

        The next exchange discards what comes meanwhile.
        """
        if self._port is None:
            raise LostError("not open")
        self._stale = True
        try:
            self._port.write(request)
        except serial.SerialTimeoutException as error:
            # What waits there would be executed before the next try, or hold it up for good.
            self._port.reset_output_buffer()
            raise self._failed(error) from None
        except OSError as error:
            raise self._failed(error) from None

    def doubt(self) -> None:
        """Assume that bytes of an older exchange can still come, until the line was silent."""
        self._stale = True

    def _failed(self, error: OSError | DeviceError) -> DeviceError:
        """Return the error to raise, and protect the next request from late bytes."""
        self._stale = True
        if isinstance(error, OSError) and not isinstance(error, serial.SerialTimeoutException):
            self.close()
            return LostError(f"port lost, unplugged? {why(error)}")
        if isinstance(error, DeviceError):
            return error
        return NoAnswerError(f"could not send within {self.timeout_s:g} s")

    def _await_gap(self) -> None:
        if self._waiting[0]:
            raise DeviceError(f"{self._waiting[0]} bytes that answer no request")
        early_s = self._quiet_at - self._clock()
        if early_s > 0.0:
            self._sleep(early_s)

    def _complete(self, reply: bytearray, missing: Missing, deadline: float) -> bytearray:
        while wanted := missing(reply):
            left_s = deadline - self._clock()
            if left_s <= 0.0 or not self._poll.poll(math.ceil(left_s * 1e3)):
                raise NoAnswerError(cut(len(reply), wanted, self.timeout_s))
            reply += self._read()
        return reply

    def _read(self) -> bytes:
        data = read(self._fd, _CHUNK)
        if data:
            return data
        if dict(self._poll.poll(0)).get(self._fd, 0) & ~select.POLLIN:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        raise DeviceError(
            "bytes came and were gone before they could be read: another program reads this port "
            "(lsof names it; ModemManager, brltty and terminal programs do)"
        )

    def await_silence(self, quiet_s: float, answer_s: float = 0.0) -> None:
        """Discard received bytes until the line was silent for ``quiet_s``.

        Before, wait up to ``answer_s`` for the first byte of an answer.
        """
        if self._port is None:
            raise LostError("not open")
        try:
            self._poll.poll(math.ceil(1e3 * answer_s))
            self.drain(quiet_s)
        except (OSError, DeviceError) as error:
            raise self._failed(error) from None

    def drain(self, quiet_s: float = _QUIET_S) -> None:
        """Discard received bytes until the line was silent for ``quiet_s``, or its own gap.

        Raises:
            OSError: The port broke.
            DeviceError: The line did not get silent in time.
        """
        quiet_ms = math.ceil(1e3 * max(quiet_s, self._gap_s))
        deadline = self._clock() + max(self.timeout_s, 10.0 * _QUIET_S)
        while self._poll.poll(quiet_ms):
            self._read()
            if self._clock() > deadline:
                raise DeviceError("the line does not get quiet: another device keeps sending")
        self._stale = False

    def close(self) -> None:
        """Close and unlock the port."""
        port, self._port, self._fd = self._port, None, -1
        if port is None:
            return
        if self._stale and self._settings.flow == "xonxoff":
            # Closing waits for bytes that a device with its XOFF out never takes, 30 s and more.
            import termios

            with contextlib.suppress(termios.error):  # where the port is gone
                port.reset_output_buffer()
        if self._exclusive:
            admit_others(port.fileno())
            self._exclusive = False
        port.close()
