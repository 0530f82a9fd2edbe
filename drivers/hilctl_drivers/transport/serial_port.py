"""Serial port as a link."""

import contextlib
import errno
import os
import select
import time
from collections.abc import Callable
from io import FileIO
from typing import TypeAlias

import serial
from serial.rs485 import RS485Settings

from hilctl.base.errors import DeviceError
from hilctl.base.files import PORT_REMEDIES, reason
from hilctl_drivers.profile_base import SerialLineSettings
from hilctl_drivers.transport.links import LostError
from hilctl_drivers.transport.port_identity import PortIdentity
from hilctl_drivers.transport.resource_names import admit_others, refuse_to_others
from hilctl_drivers.transport.stream_link import StreamLink

_Port: TypeAlias = serial.Serial | FileIO


def _open_port(path: str, settings: SerialLineSettings) -> serial.Serial:
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
        rtscts=settings.flow == "rts_cts",
        exclusive=True,
    )
    if settings.dtr is not None:
        port.dtr = settings.dtr
    if settings.rts is not None:
        port.rts = settings.rts
    if settings.rs485 is not None:
        high = settings.rs485 == "high"
        port.rs485_mode = RS485Settings(rts_level_for_tx=high, rts_level_for_rx=not high)
    port.port = path
    port.open()
    if settings.boot_wait_s > 0.0:
        try:
            _keep_levels(port.fileno())
        except OSError:
            port.close()
            raise
    return port


def _open_again(path: str, settings: SerialLineSettings) -> _Port:
    """Open a port of a run for the safe value.

    pyserial takes five descriptors. If this process lacks them, one is used without a lock; the
    system keeps the settings of a port.
    """
    try:
        return _open_port(path, settings)
    except OSError as error:
        if error.errno not in {errno.EMFILE, errno.ENFILE}:
            raise
    flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
    return FileIO(path, "r+", opener=lambda path, _: os.open(path, flags))


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


class SerialLink(StreamLink):
    """A serial port with exclusive access to the device that it first led to."""

    LOST = "port lost, unplugged?"

    def __init__(
        self,
        port: str,
        settings: SerialLineSettings,
        timeout_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(settings.silence_s, timeout_s, clock, sleep, echo=settings.removes_echo)
        self._settings = settings
        self._port: _Port | None = None
        self._exclusive = False
        # Before the first opening: the guardian opens the port only after a run has failed.
        self.identity = PortIdentity(port)

    def open(self, *, boot: bool = True) -> None:
        """Open and lock the port, see :meth:`StreamLink.open`."""
        self.close()
        try:
            # Not the path: a link may be moved in between.
            file = self.identity.device_file()
            self._port = port = (_open_port if boot else _open_again)(file, self._settings)
        except (OSError, ValueError) as error:
            text = reason(error, PORT_REMEDIES) if isinstance(error, OSError) else str(error)
            if self._settings.rs485 is not None and isinstance(error, ValueError):
                text += " (omit rs485 if the adapter switches its direction itself)"
            raise LostError(f"cannot be opened: {text}") from None
        # Otherwise an FTDI adapter holds bytes back for up to 16 ms; ptys and USB CDC refuse it.
        if isinstance(port, serial.Serial):
            with contextlib.suppress(OSError, ValueError, NotImplementedError):
                port.set_low_latency_mode(True)
        self._use(port.fileno())
        if boot:
            self._exclusive = refuse_to_others(self._fd, file)
            self._stale = True
            boot_wait_s = self._settings.boot_wait_s
            self.boot_hint = (
                "; if opening the port resets the device, set boot_wait_s to the time until it "
                f"answers (now {boot_wait_s:g} s)"
            )
            self._sleep(boot_wait_s)
        self._quiet_at = self._clock()

    def _discard_unsent(self) -> None:
        import termios

        with contextlib.suppress(termios.error):  # the port is gone
            termios.tcflush(self._fd, termios.TCOFLUSH)

    def _nothing_read(self) -> None:
        if dict(self._poll.poll(0)).get(self._fd, 0) & ~select.POLLIN:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        raise DeviceError(
            "received bytes disappeared before they were read: another program reads this port "
            "(lsof names it; ModemManager, brltty and terminal programs do)"
        )

    def close(self) -> None:
        """Close and unlock the port."""
        if self._port is None:
            return
        if self._stale and self._settings.flow != "none":
            # Closing waits for bytes that a pausing device never takes, 30 s and more.
            self._discard_unsent()
        if self._exclusive:
            admit_others(self._fd)
            self._exclusive = False
        port, self._port, self._fd = self._port, None, -1
        port.close()
