"""TCP connections as links."""

import math
import select
import socket
import struct
import time
from collections.abc import Callable
from typing import ClassVar

from hilctl.base.errors import DeviceError
from hilctl.base.files import CONNECT_REMEDIES
from hilctl_drivers.transport.links import LostError, Missing, NoAnswerError, cut, wait_ms, why
from hilctl_drivers.transport.stream_link import StreamLink

_FIRST = 256
"""Most replies are shorter; buffers up to 512 bytes come from Python's own pool, which is faster
than the system's."""
_CHUNK = 4096
_RECEIVED, _MOST_CHUNKS = 65536, 64
"""Bytes of one read of unsolicited data, and reads at a time."""
_SO_TIMESTAMPNS = 35
"""Option of Linux that Python does not name: the kernel's time of arrival with the data."""
_TIMESPEC = struct.Struct("@ll")
_NOTE_SIZE = 64
"""Room for that time, with its header."""


def _connected(address: tuple[str, int], timeout_s: float) -> tuple[socket.socket, str]:
    """Return a connection without Nagle's delay, and the peer's address, or raise LostError."""
    try:
        made = socket.create_connection(address, timeout_s)
    except TimeoutError:
        raise LostError(f"no connection within {timeout_s:g} s") from None
    except OSError as error:
        raise LostError(f"cannot connect: {why(error, CONNECT_REMEDIES)}") from None
    try:
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # What is not acknowledged by then is given up, also where this process dies: else the
        # kernel sends an old command again when the cable is back.
        unacknowledged_ms = math.ceil(timeout_s * 1e3)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, unacknowledged_ms)
        return made, str(made.getpeername()[0])
    except OSError as error:  # reset since
        made.close()
        raise LostError(f"cannot connect: {why(error)}") from None


class _Connection:
    """A TCP connection; ``timeout_s`` is the longest time to connect, and of one exchange."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self._host, self._port = host, port  # a numeric address after connecting
        self._timeout_s = timeout_s
        self._socket: socket.socket | None = None

    def _connect(self) -> socket.socket:
        self.close()
        made, self._host = _connected((self._host, self._port), self._timeout_s)
        self._socket = made
        return made

    @property
    def is_open(self) -> bool:
        """Whether it is open, as far as is known."""
        return self._socket is not None

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _reset(self) -> None:
        """Reset the connection, so that undelivered data cannot reach the peer later."""
        if self._socket is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        _Connection.close(self)


class TcpLink(_Connection):
    """A TCP connection for numbered replies, such as those of Modbus TCP."""

    def __init__(
        self, host: str, port: int, timeout_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(host, port, timeout_s)
        self._clock = clock

    def open(self) -> None:
        """Connect, see :meth:`~hilctl_drivers.transport.links.Link.open`."""
        made = self._connect()
        made.settimeout(None)
        # The kernel's own time-outs spare the poll() before each call that Python's would cost.
        seconds, fraction = divmod(self._timeout_s, 1.0)
        limit = struct.pack("ll", int(seconds), max(1, int(fraction * 1e6)))
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)

    def transact(
        self, request: bytes | bytearray, missing: Missing, usual: int = 0
    ) -> bytes | bytearray:
        """Exchange, see :meth:`~hilctl_drivers.transport.links.Link.transact`.

        After a failure the connection is reset: a late reply could only be taken for the reply to
        the next request, and an undelivered request must not be delivered later.
        """
        connection = self._socket
        if connection is None:
            raise LostError("not connected")
        deadline = self._clock() + self._timeout_s
        try:
            connection.sendall(request)
            if not usual and not missing(bytearray()):
                return b""
            reply = connection.recv(_FIRST)
            if len(reply) == usual > 0:
                return reply
            return self._rest(connection, bytearray(reply), missing, deadline)
        except BlockingIOError:
            self._reset()
            raise NoAnswerError(f"no answer within {self._timeout_s:g} s") from None
        except OSError as error:
            self._reset()
            raise LostError(f"connection lost: {why(error)}") from None
        except DeviceError:
            self._reset()
            raise

    def _rest(
        self, connection: socket.socket, reply: bytearray, missing: Missing, deadline: float
    ) -> bytearray:
        if not reply:
            raise LostError("connection closed by the device")
        poll, late = select.poll(), False
        poll.register(connection, select.POLLIN)
        while wanted := missing(reply):
            if late or not poll.poll(wait_ms(deadline, self._clock())):
                raise NoAnswerError(cut(len(reply), wanted, self._timeout_s))
            late = self._clock() > deadline
            data = connection.recv(_CHUNK)
            if not data:
                raise LostError(f"connection closed by the device, {wanted} bytes before the end")
            reply += data
        return reply

    def doubt(self) -> None:
        """Close the connection: the next one has no late replies."""
        self.close()


class TcpReceiver(_Connection):
    """A TCP connection on which only the device sends."""

    DATAGRAMS: ClassVar[bool] = False
    _looked_ns = 0

    def open(self) -> None:
        """Connect; raise LostError if no device answers."""
        self._looked_ns = time.monotonic_ns()
        made = self._connect()
        made.setblocking(False)
        try:
            made.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        except OSError as error:  # reset since
            raise LostError(f"connection lost: {why(error)}") from None

    def wait(self, wait_s: float) -> bool:
        """Wait for data; return whether any has arrived."""
        assert self._socket is not None
        return bool(select.select([self._socket], [], [], max(0.0, wait_s))[0])

    def receive(self) -> tuple[bytes, int]:
        """Return received bytes, without waiting, and the age of the last byte in ns.

        The kernel reports the time of arrival. Without it, the age is the time since the last call,
        which also limits the effect of a change of the system's clock.

        Raises:
            LostError: The link is not open, or broke.
        """
        if self._socket is None:
            raise LostError("not open")
        received, arrived_ns = b"", 0
        looked_ns, self._looked_ns = self._looked_ns, time.monotonic_ns()
        try:
            for _ in range(_MOST_CHUNKS):
                data, notes, _flags, sender = self._socket.recvmsg(_RECEIVED, _NOTE_SIZE)
                if self.DATAGRAMS:
                    data = data if sender[0] == self._host else b""
                elif not data:
                    raise LostError("connection closed by the device")
                received += data
                for _level, _kind, stamp in notes:
                    seconds, ns = _TIMESPEC.unpack(stamp)
                    arrived_ns = seconds * 10**9 + ns
                if len(data) < _RECEIVED and not self.DATAGRAMS:
                    break
        except BlockingIOError:
            pass
        except OSError as error:
            raise LostError(f"connection lost: {why(error)}") from None
        age_ns = max(0, time.time_ns() - arrived_ns)
        return received, min(age_ns, time.monotonic_ns() - looked_ns)


class UdpReceiver(TcpReceiver):
    """A UDP port of this machine; datagrams of other senders than the device are discarded."""

    DATAGRAMS: ClassVar[bool] = True

    def _connect(self) -> socket.socket:
        self.close()
        try:
            family, *_, address = socket.getaddrinfo(
                self._host, self._port, type=socket.SOCK_DGRAM
            )[0]
            self._host = str(address[0])
            self._socket = made = socket.socket(family, socket.SOCK_DGRAM)
            made.bind(("", self._port))
        except OSError as error:
            self.close()
            raise LostError(f"cannot listen on UDP port {self._port}: {why(error)}") from None
        return made


class TcpStream(_Connection, StreamLink):
    """A TCP connection for text, or to a serial line behind a serial server.

    A late reply may still come on the next connection: the server has it from its line.
    """

    LOST = "connection lost:"

    def __init__(
        self, host: str, port: int, timeout_s: float, gap_s: float = 0.0, *, echo: bool = False
    ) -> None:
        _Connection.__init__(self, host, port, timeout_s)
        StreamLink.__init__(self, gap_s, timeout_s, echo=echo)

    def open(self, *, boot: bool = True) -> None:
        """Connect, see :meth:`StreamLink.open`."""
        self._use(self._connect().fileno())  # with its time-out set, Python keeps it non-blocking
        if boot:
            self._stale = True

    def _nothing_read(self) -> None:
        self.close()
        raise LostError("connection closed by the device")

    def close(self) -> None:
        """Close the connection; break it if it has failed, so no older request arrives later."""
        self._fd = -1
        if self._stale:
            self._reset()
        else:
            super().close()
