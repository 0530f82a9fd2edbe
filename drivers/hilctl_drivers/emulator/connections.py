"""Where requests come in: connections over TCP, and ptys that stand for serial ports."""

import os
import pty
import socket
import struct
import termios
import tty
from abc import ABC, abstractmethod
from contextlib import suppress

from hilctl_drivers.emulator.wire import EmulatedWire

_CHUNK = 65536


class Connection(ABC):
    """A host's way to a wire.

    Args:
        wire: What it asks.
        faulty: Whether the server's faults happen here.
    """

    def __init__(self, wire: EmulatedWire, *, faulty: bool) -> None:
        self.wire = wire
        self.faulty = faulty
        self.received = bytearray()
        """What has come and is not a complete request yet."""
        self.received_ns = 0
        """When the last of it came."""
        self.unsent = bytearray()
        """What waits for room, as in a USB device's buffer."""

    @abstractmethod
    def fileno(self) -> int:
        """What to wait for."""

    @abstractmethod
    def read(self) -> bytes | None:
        """Return what came; None where the host has gone."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send, as far as there is room; the rest with the next call."""

    @abstractmethod
    def unplug(self) -> None:
        """Fall silent for good; to be closed all the same."""

    @abstractmethod
    def close(self, *, reset: bool = False) -> None:
        """Hang up, or break the connection."""


class TcpConnection(Connection):
    """A connection over TCP.

    Args:
        connection: Accepted.
        wire: What it asks.
    """

    def __init__(self, connection: socket.socket, wire: EmulatedWire) -> None:
        super().__init__(wire, faulty=True)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection

    def fileno(self) -> int:
        """See :meth:`Connection.fileno`."""
        return self._connection.fileno()

    def read(self) -> bytes | None:
        """See :meth:`Connection.read`."""
        with suppress(OSError):  # a host that died is as good as one that hung up
            return self._connection.recv(_CHUNK) or None
        return None

    def send(self, data: bytes) -> None:
        """See :meth:`Connection.send`."""
        with suppress(OSError):
            self._connection.sendall(data)

    def unplug(self) -> None:
        """See :meth:`Connection.unplug`; a pulled network cable closes no connection."""

    def close(self, *, reset: bool = False) -> None:
        """See :meth:`Connection.close`."""
        if reset:
            linger = struct.pack("ii", 1, 0)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self._connection.close()


class PtyConnection(Connection):
    """Whatever opens the other end of a pty.

    Args:
        wire: What it asks.
        faulty: Whether the server's faults happen here.
    """

    def __init__(self, wire: EmulatedWire, *, faulty: bool) -> None:
        super().__init__(wire, faulty=faulty)
        # Our own hold on the other end keeps the line from ending when a host lets go of it.
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)

    def fileno(self) -> int:
        """See :meth:`Connection.fileno`."""
        return self._master

    def read(self) -> bytes | None:
        """See :meth:`Connection.read`."""
        with suppress(BlockingIOError):
            return os.read(self._master, _CHUNK)
        return b""

    def send(self, data: bytes) -> None:
        """See :meth:`Connection.send`."""
        self.unsent += data
        with suppress(BlockingIOError):
            while self.unsent:
                del self.unsent[: os.write(self._master, self.unsent)]

    def unplug(self) -> None:
        """See :meth:`Connection.unplug`; a pulled adapter takes its port along."""
        os.close(self._master)
        self._master = -1

    def close(self, *, reset: bool = False) -> None:
        """See :meth:`Connection.close`; a pty has nothing to break."""
        del reset
        if self._master >= 0:
            os.close(self._master)
        # Last: until then no other pty gets its name, which a host may still be trying.
        os.close(self._slave)
