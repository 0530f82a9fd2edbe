"""Serves an emulated Modbus device over TCP and over a pty, with faults where they are wanted.

One thread and no locks: requests, the rig's time and the watchdog take turns.
"""

import heapq
import os
import pty
import selectors
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

from hilctl.errors import InputError
from hilctl_drivers.emulator.emulated import EmulatedDevice
from hilctl_drivers.emulator.faults import Fault, FaultPlan, spoil
from hilctl_drivers.emulator.modbus_wire import CORRUPT_AT, ModbusWire

TICK_S = 0.01
_STALE_NS = 50_000_000
_CHUNK = 4096


class Peer(Protocol):
    """Somebody who sends requests."""

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


class _TcpPeer:
    def __init__(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        self.received = bytearray()
        self.heard_ns = 0

    def fileno(self) -> int:
        return self._connection.fileno()

    def read(self) -> bytes:
        with suppress(OSError):  # a host that died is as good as one that hung up
            return self._connection.recv(_CHUNK)
        return b""

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            self._connection.sendall(data)

    def close(self, *, reset: bool = False) -> None:
        if reset:
            linger = struct.pack("ii", 1, 0)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self._connection.close()


class _PtyPeer:
    def __init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        self.name = os.ttyname(self._slave)
        self.received = bytearray()
        self.heard_ns = 0

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        return os.read(self._master, _CHUNK)  # our own end of the line keeps it from ending

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def close(self, *, reset: bool = False) -> None:
        del reset
        os.close(self._master)
        os.close(self._slave)


class ModbusServer:
    """Answers requests until it is stopped.

    Args:
        device: What it serves.
        wire: Its framing.
        faults: What goes wrong.
        mute: Functions that are never answered, as some devices do with those they don't know.
        clock_ns: Monotonic time.
    """

    def __init__(
        self,
        device: EmulatedDevice,
        wire: ModbusWire,
        faults: Sequence[Fault] = (),
        mute: frozenset[int] = frozenset(),
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._device = device
        self._wire = wire
        self._plan = FaultPlan(faults)
        self._mute = mute
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._selector = selectors.DefaultSelector()
        self._listener: socket.socket | None = None
        self._peers: list[Peer] = []
        self._late: list[tuple[int, int, Peer, bytes]] = []
        self._stopping = False

    def listen_tcp(self, host: str, port: int) -> int:
        """Listen; return the port, which is a free one where 0 is asked for.

        Raises:
            InputError: The port is in use or not ours to have.
        """
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise InputError(f"can't listen on {host}:{port}: {error.strerror}") from None
        self._selector.register(self._listener, selectors.EVENT_READ)
        return int(self._listener.getsockname()[1])

    def open_pty(self) -> str:
        """Open a pty and return the device file of its other end."""
        peer = _PtyPeer()
        self._add(peer)
        return peer.name

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        while not self._stopping:
            for key, _ in self._selector.select(self._pause_s()):
                self._serve(key.fileobj)
            now_ns = self._clock_ns()
            self._device.tick(now_ns)
            while self._late and self._late[0][0] <= now_ns:
                _, _, peer, reply = heapq.heappop(self._late)
                if peer in self._peers:
                    peer.send(reply)
        self._close()

    def stop(self) -> None:
        """Make :meth:`run` end; from any thread or signal handler."""
        self._stopping = True  # noticed at the next tick of the rig

    def _pause_s(self) -> float:
        if not self._late:
            return TICK_S
        return min(TICK_S, max(0.0, (self._late[0][0] - self._clock_ns()) * 1e-9))

    def _serve(self, who: object) -> None:
        if who is self._listener and self._listener is not None:
            self._add(_TcpPeer(self._listener.accept()[0]))
        elif isinstance(who, _TcpPeer | _PtyPeer) and who in self._peers:
            self._hear(who)

    def _add(self, peer: Peer) -> None:
        self._peers.append(peer)
        self._selector.register(peer, selectors.EVENT_READ)

    def _drop(self, peer: Peer, *, reset: bool = False) -> None:
        self._peers.remove(peer)
        self._selector.unregister(peer)
        peer.close(reset=reset)

    def _hear(self, peer: Peer) -> None:
        data = peer.read()
        if not data:
            self._drop(peer)
            return
        now_ns = self._clock_ns()
        if now_ns - peer.heard_ns > _STALE_NS:
            peer.received.clear()  # half a request that was given up
        peer.heard_ns = now_ns
        peer.received += data
        while peer.received and peer in self._peers:
            used, request = self._wire.take(bytes(peer.received))
            if not used:
                return
            del peer.received[:used]
            if request:
                self._answer(peer, request)

    def _answer(self, peer: Peer, request: bytes) -> None:
        now_ns = self._clock_ns()
        fault = self._plan.next((now_ns - self._start_ns) * 1e-9)
        if request[3] in self._mute:
            return
        if fault is None:
            peer.send(self._wire.answer(request, now_ns))
        else:
            self._misbehave(fault, peer, request, now_ns)

    def _misbehave(self, fault: Fault, peer: Peer, request: bytes, now_ns: int) -> None:
        """Do what a fault says; those that keep the reply back keep the request back too."""
        if fault.kind == "unplug":
            self._unplug()
        elif fault.kind == "reset":
            self._drop(peer, reset=True)
        elif fault.kind == "exception":
            peer.send(self._wire.refusal(request, 4))
        elif fault.kind != "silence":
            reply = self._wire.answer(request, now_ns)
            if fault.kind == "wrong_id":
                reply = self._wire.wrong_id(request, reply)
            reply = spoil(fault.kind, reply, CORRUPT_AT)
            if fault.kind == "delay":
                due_ns = now_ns + round(fault.delay_s * 1e9)
                heapq.heappush(self._late, (due_ns, self._plan.count, peer, reply))
            else:
                peer.send(reply)

    def _unplug(self) -> None:
        """Fall silent for good.

        A pulled network cable closes no connection; a pulled adapter takes its port along.
        """
        for peer in list(self._peers):
            if isinstance(peer, _PtyPeer):
                self._drop(peer)
            else:
                self._selector.unregister(peer)
        if self._listener is not None:
            self._selector.unregister(self._listener)

    def _close(self) -> None:
        for peer in self._peers:
            peer.close()
        self._peers.clear()
        if self._listener is not None:
            self._listener.close()
        self._selector.close()
