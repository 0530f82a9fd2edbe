"""Bytes over TCP and serial lines: one request, one reply, never longer than the time-out.

Nothing is pipelined and nothing is sent twice. A reply ends where its own bytes say so, which the
caller works out from what has come so far; pauses between bytes mean nothing. Texts of errors leave
out who was asked for what: the device that owns the link adds it.
"""

import array
import errno
import math
import os
import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from fcntl import ioctl
from termios import FIONREAD
from typing import Literal, Protocol, TypeAlias

import serial

from hilctl.errors import DeviceError

Missing: TypeAlias = Callable[[bytearray], int]
"""How many more bytes to wait for, at least, after those that have come; 0 where the reply is
there. It may raise where they can't be the beginning of one."""

_CHUNK = 1024
_QUIET_S = 0.02


class NoAnswerError(DeviceError):
    """Nothing, or not all of a reply, came in time."""


class LostError(DeviceError):
    """The connection is gone: refused, reset, closed by the peer, or unplugged."""


class Link(Protocol):
    """A way to send a request and get its reply."""

    @property
    def name(self) -> str:
        """Where it leads, for messages: ``host:port`` or the serial port."""
        ...

    def open(self) -> None:
        """Connect.

        Raises:
            LostError: There is nobody, or the port is in use.
        """
        ...

    def transact(self, request: bytes | bytearray, missing: Missing, usual: int = 0) -> bytearray:
        """Send ``request`` and return the whole reply.

        Args:
            request: What to send.
            missing: Says how much of the reply is still to come.
            usual: Size of a good reply, where it is known: ``missing`` is not asked then when just
                that much has come.

        Raises:
            NoAnswerError: The reply was not complete in time.
            LostError: The link is not open, or broke.
            DeviceError: Bytes came that are no reply.
        """
        ...

    def close(self) -> None:
        """Let go of it; closing twice is fine."""
        ...


def _why(error: OSError) -> str:
    text = error.strerror or str(error)
    return text[:1].lower() + text[1:]


class TcpLink:
    """A TCP connection without Nagle's delay.

    Args:
        host: Name or address.
        port: TCP port.
        timeout_s: Longest that connecting, or one exchange, may take.
        clock: Monotonic time in s.
    """

    def __init__(
        self, host: str, port: int, timeout_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._address = (host, port)
        self._timeout_s = timeout_s
        self._clock = clock
        self._socket: socket.socket | None = None

    @property
    def name(self) -> str:
        """``host:port``."""
        return f"{self._address[0]}:{self._address[1]}"

    def open(self) -> None:
        """Connect, see :meth:`Link.open`."""
        self.close()
        try:
            made = socket.create_connection(self._address, self._timeout_s)
        except TimeoutError:
            raise LostError(f"no connection within {self._timeout_s:g} s") from None
        except OSError as error:
            raise LostError(f"can't connect: {_why(error)}") from None
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.settimeout(None)
        # The kernel's own time-outs spare the poll() before each call that Python's would cost.
        seconds, fraction = divmod(self._timeout_s, 1.0)
        limit = struct.pack("ll", int(seconds), max(1, int(fraction * 1e6)))
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        self._socket = made

    def transact(self, request: bytes | bytearray, missing: Missing, usual: int = 0) -> bytearray:
        """Exchange, see :meth:`Link.transact`; after a time-out the connection is closed.

        A late reply could only be taken for that of the next request.
        """
        if self._socket is None:
            raise LostError("not connected")
        deadline = self._clock() + self._timeout_s
        try:
            self._socket.sendall(request)
            if not usual and not missing(bytearray()):
                return bytearray()
            reply = bytearray(self._socket.recv(_CHUNK))
            if len(reply) == usual > 0:
                return reply
            return self._rest(self._socket, reply, missing, deadline)
        except BlockingIOError:
            self.close()
            raise NoAnswerError(f"no answer within {self._timeout_s:g} s") from None
        except OSError as error:
            self.close()
            raise LostError(f"connection lost: {_why(error)}") from None
        except DeviceError:
            self.close()
            raise

    def _rest(
        self, connection: socket.socket, reply: bytearray, missing: Missing, deadline: float
    ) -> bytearray:
        if not reply:
            raise LostError("connection closed by the device")
        while wanted := missing(reply):
            reply += self._more(connection, len(reply), wanted, deadline)
        return reply

    def _more(self, connection: socket.socket, got: int, wanted: int, deadline: float) -> bytes:
        left_s = deadline - self._clock()
        if left_s <= 0.0 or not select.select([connection], [], [], left_s)[0]:
            raise NoAnswerError(_cut(got, wanted, self._timeout_s))
        data = connection.recv(_CHUNK)
        if not data:
            raise LostError(f"connection closed by the device, {wanted} bytes before the end")
        return data

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _cut(got: int, wanted: int, timeout_s: float) -> str:
    what = f"only {got} bytes, {wanted} short," if got else "no answer"
    return f"{what} within {timeout_s:g} s"


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """How a serial line is set.

    Attributes:
        baud: Bits a second.
        bytesize: Data bits of a character.
        parity: N, E or O.
        stopbits: Stop bits.
        gap_s: Silence to keep between a reply and the next request.
        boot_s: How long the device needs after the port is opened; boards that reset on it.
    """

    baud: int = 9600
    bytesize: Literal[7, 8] = 8
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    gap_s: float = 0.0
    boot_s: float = 0.0


class SerialLink:
    """A serial port that is ours alone.

    Args:
        port: Device file; ``/dev/serial/by-id/...`` stays the same when ports are renumbered.
        settings: How the line is set.
        timeout_s: Longest that one exchange may take.
        clock: Monotonic time in s.
        sleep: Waits that many s.
    """

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
        self._timeout_s = timeout_s
        self._timeout_ms = math.ceil(timeout_s * 1e3)
        self._clock = clock
        self._sleep = sleep
        self._port: serial.Serial | None = None
        self._fd = -1
        self._poll = select.poll()
        self._waiting = array.array("i", [0])
        self._stale = False
        self._quiet_at = 0.0
        self.low_latency = False
        """Whether the driver took the low-latency setting; without it an FTDI adapter holds bytes
        back for up to 16 ms."""

    @property
    def name(self) -> str:
        """The port's device file."""
        return self._path

    def open(self) -> None:
        """Open and lock the port, see :meth:`Link.open`, and throw away what it holds."""
        self.close()
        settings = self._settings
        try:
            port = serial.Serial(
                self._path,
                settings.baud,
                settings.bytesize,
                settings.parity,
                settings.stopbits,
                timeout=0.0,
                write_timeout=self._timeout_s,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            raise LostError(f"can't be opened: {error}") from None
        try:
            port.set_low_latency_mode(True)
            self.low_latency = True
        except (OSError, ValueError, NotImplementedError):  # ptys and USB CDC have no such setting
            self.low_latency = False
        self._port, self._fd = port, port.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._sleep(settings.boot_s)
        self._stale = True
        self._quiet_at = self._clock()

    def transact(self, request: bytes | bytearray, missing: Missing, usual: int = 0) -> bytearray:
        """Exchange, see :meth:`Link.transact`.

        After a failure the next request waits until the line is quiet and throws away what came:
        serial protocols don't number their replies, so a late one would pass for the next.
        """
        if self._port is None:
            raise LostError("not open")
        try:
            if self._stale:
                self.drain()
            ioctl(self._fd, FIONREAD, self._waiting)
            if self._waiting[0] or self._gap_s:
                self._await_gap()
            deadline = self._clock() + self._timeout_s
            self._send(request)
            if usual and self._poll.poll(self._timeout_ms):
                reply = bytearray(os.read(self._fd, _CHUNK))
                if len(reply) != usual:
                    self._complete(reply, missing, deadline)
            else:
                reply = self._receive(missing, deadline)
        except serial.SerialTimeoutException:
            self._stale = True
            raise NoAnswerError(f"could not send within {self._timeout_s:g} s") from None
        except OSError as error:  # pyserial's own errors are OSErrors too
            self.close()
            raise LostError(f"port lost, unplugged? {_why(error)}") from None
        except DeviceError:
            self._stale = True
            raise
        if self._gap_s:
            self._quiet_at = self._clock() + self._gap_s
        return reply

    def _await_gap(self) -> None:
        if self._waiting[0]:
            raise DeviceError(f"{self._waiting[0]} bytes that nobody asked for")
        early_s = self._quiet_at - self._clock()
        if early_s > 0.0:
            self._sleep(early_s)

    def _send(self, request: bytes | bytearray) -> None:
        # Past pyserial where all goes at once, as it does; it takes three times as long. Never
        # flush(): that hangs on ptys and USB CDC.
        try:
            sent = os.write(self._fd, request)
        except BlockingIOError:
            sent = 0
        if sent < len(request) and self._port is not None:
            self._port.write(request[sent:])

    def _receive(self, missing: Missing, deadline: float) -> bytearray:
        reply = bytearray()
        self._complete(reply, missing, deadline)
        return reply

    def _complete(self, reply: bytearray, missing: Missing, deadline: float) -> None:
        while wanted := missing(reply):
            left_s = deadline - self._clock()
            if left_s <= 0.0 or not self._poll.poll(math.ceil(left_s * 1e3)):
                raise NoAnswerError(_cut(len(reply), wanted, self._timeout_s))
            reply += self._read()

    def _read(self) -> bytes:
        data = os.read(self._fd, _CHUNK)
        if not data:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return data

    def drain(self) -> None:
        """Throw away what comes until nothing has come for a while.

        Raises:
            LostError: The port broke.
            DeviceError: The line did not get quiet in time.
        """
        quiet_ms = math.ceil(1e3 * max(_QUIET_S, self._settings.gap_s))
        deadline = self._clock() + max(self._timeout_s, 10.0 * _QUIET_S)
        while self._poll.poll(quiet_ms):
            self._read()
            if self._clock() > deadline:
                raise DeviceError("the line does not get quiet: somebody keeps sending")
        self._stale = False

    def close(self) -> None:
        """Close and unlock the port."""
        if self._port is not None:
            self._port.close()
            self._port = None
            self._fd = -1
