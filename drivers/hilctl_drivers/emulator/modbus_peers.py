"""Who sends requests to an emulated Modbus device: connections, and a host at a pty."""

import os
import pty
import socket
import struct
import termios
import tty
from contextlib import suppress
from typing import Protocol

from hilctl_drivers.emulator.modbus_wire import ModbusWire

_CHUNK = 4096


class Peer(Protocol):
    """Somebody who sends requests."""

    wire: ModbusWire
    received: bytearray
    heard_ns: int

    def fileno(self) -> int:
        """What to wait for."""
        ...

    def read(self) -> bytes:
        """Return what came; nothing where it has gone."""
        ...

    def send(self, data: bytes) -> None:
        """Send."""
        ...

    def close(self, *, reset: bool = False) -> None:
        """Hang up, or break the connection."""
        ...


class TcpPeer:
    """A connection.

    Args:
        connection: Accepted.
        wire: What it asks.
    """

    def __init__(self, connection: socket.socket, wire: ModbusWire) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        self.wire = wire
        self.received = bytearray()
        self.heard_ns = 0

    def fileno(self) -> int:
        """See :meth:`Peer.fileno`."""
        return self._connection.fileno()

    def read(self) -> bytes:
        """See :meth:`Peer.read`."""
        with suppress(OSError):  # a host that died is as good as one that hung up
            return self._connection.recv(_CHUNK)
        return b""

    def send(self, data: bytes) -> None:
        """See :meth:`Peer.send`."""
        with suppress(OSError):
            self._connection.sendall(data)

    def close(self, *, reset: bool = False) -> None:
        """See :meth:`Peer.close`."""
        if reset:
            linger = struct.pack("ii", 1, 0)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self._connection.close()


class PtyPeer:
    """Whoever opens the other end of a pty.

    Args:
        wire: What it asks.
    """

    def __init__(self, wire: ModbusWire) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        self.name = os.ttyname(self._slave)
        self.wire = wire
        self.received = bytearray()
        self.heard_ns = 0

    def fileno(self) -> int:
        """See :meth:`Peer.fileno`."""
        return self._master

    def read(self) -> bytes:
        """See :meth:`Peer.read`."""
        return os.read(self._master, _CHUNK)  # our own end of the line keeps it from ending

    def send(self, data: bytes) -> None:
        """See :meth:`Peer.send`."""
        os.write(self._master, data)

    def close(self, *, reset: bool = False) -> None:
        """See :meth:`Peer.close`; a pty has nothing to break."""
        del reset
        os.close(self._master)
        os.close(self._slave)
