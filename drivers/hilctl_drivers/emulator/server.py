"""Server of emulated devices on TCP ports and ptys, with injected faults.

One thread and no locks: requests, the rig's time, watchdogs and sample clocks take turns.
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
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress

from hilctl.base.errors import InputError
from hilctl.base.files import ADDRESS_REMEDIES, reason
from hilctl_drivers.emulator.options import FaultPlan, WireFault, spoil
from hilctl_drivers.emulator.wire import EmulatedReply, EmulatedWire

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
        """Return what came; None if the host has gone."""

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
    """Connection to the program at the other end of a pty.

    Args:
        wire: What it asks.
        faulty: Whether the server's faults happen here.
    """

    def __init__(self, wire: EmulatedWire, *, faulty: bool) -> None:
        super().__init__(wire, faulty=faulty)
        # Kept open, so that the line does not end when a host closes it.
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


_TICK_S = 0.005
_STALE_NS = 1_000_000_000  # a busy machine may pass on in parts what was written at once


class EmulatorServer:
    """Answers requests until it is stopped.

    Args:
        faults: What goes wrong.
        clock_ns: Monotonic time.
    """

    def __init__(
        self, faults: Sequence[WireFault] = (), clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._plan = FaultPlan(faults)
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._selector = selectors.DefaultSelector()
        self._wires: list[EmulatedWire] = []
        self._listeners: dict[socket.socket, EmulatedWire] = {}
        self._connections: list[Connection] = []
        self._unplugged: list[Connection | socket.socket] = []
        self._late: list[tuple[int, int, Connection, EmulatedReply, WireFault | None]] = []
        self._undone: list[tuple[int, int, Connection, bytes]] = []
        self._count = 0
        self._stopping = False

    def listen_tcp(self, wire: EmulatedWire, host: str, port: int) -> str:
        """Listen; return ``host:port``, which is a free one where port 0 is asked for.

        Raises:
            InputError: The port is in use or not ours to have.
        """
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            why = reason(error, ADDRESS_REMEDIES)
            raise InputError(f"can't listen on {host}:{port}: {why}") from None
        self._listeners[listener] = wire
        self._wires.append(wire)
        self._selector.register(listener, selectors.EVENT_READ)
        return f"{host}:{listener.getsockname()[1]}"

    def open_pty(self, wire: EmulatedWire, *, faulty: bool = True) -> str:
        """Open a pty and return the device file of its other end."""
        connection = PtyConnection(wire, faulty=faulty)
        self._wires.append(wire)
        self._add(connection)
        return connection.name

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        while not self._stopping:
            for key, events in self._selector.select(self._pause_s()):
                self._serve(key.fileobj, events)
            now_ns = self._clock_ns()
            for wire in self._wires:
                wire.tick(now_ns)
            self._carry_out_due(now_ns)
            self._send_due(now_ns)
        self.close()

    def stop(self) -> None:
        """Make :meth:`run` end; from any thread or signal handler."""
        self._stopping = True  # noticed at the next tick of the rig

    def close(self) -> None:
        """Close everything; for a server that does not :meth:`run`."""
        for each in (*self._connections, *self._listeners, *self._unplugged):
            each.close()
        self._connections.clear()
        self._listeners.clear()
        self._unplugged.clear()
        self._selector.close()

    def _pause_s(self) -> float:
        due_ns = [each[0][0] for each in (self._late, self._undone) if each]
        if not due_ns:
            return _TICK_S
        return min(_TICK_S, max(0.0, (min(due_ns) - self._clock_ns()) * 1e-9))

    def _serve(self, source: object, events: int) -> None:
        if source in self._listeners:
            assert isinstance(source, socket.socket)
            self._add(TcpConnection(source.accept()[0], self._listeners[source]))
        elif source in self._connections:  # otherwise it was closed since
            assert isinstance(source, Connection)
            if events & selectors.EVENT_WRITE:
                self._selector.modify(source, selectors.EVENT_READ)
                self._send(source, b"")
            if events & selectors.EVENT_READ:
                self._receive(source)

    def _add(self, connection: Connection) -> None:
        self._connections.append(connection)
        self._selector.register(connection, selectors.EVENT_READ)

    def _drop(self, connection: Connection, *, reset: bool = False) -> None:
        self._connections.remove(connection)
        self._selector.unregister(connection)
        connection.close(reset=reset)

    def _receive(self, connection: Connection) -> None:
        data = connection.read()
        if data is None:
            self._drop(connection)
            return
        now_ns = self._clock_ns()
        if now_ns - connection.received_ns > _STALE_NS:
            connection.received.clear()  # half a request that was given up
        connection.received_ns = now_ns
        connection.received += data
        for request in connection.wire.requests(connection.received):
            self._answer(connection, request)
            if connection not in self._connections:
                return

    def _answer(self, connection: Connection, request: bytes) -> None:
        now_ns = self._clock_ns()
        if self._late:
            # A new request means that the host has given up on answers that are still to come.
            self._late = [each for each in self._late if each[2] is not connection or each[4]]
            heapq.heapify(self._late)
        fault = None
        if connection.faulty:
            fault = self._plan.next((now_ns - self._start_ns) * 1e-9)
        if fault is not None and fault.kind in {"silence", "unplug", "reset", "exception", "late"}:
            self._keep_back(fault, connection, request)
            return
        answer = connection.wire.answer(request, now_ns)
        if answer is None:
            return
        delay_ns = round(fault.delay_s * 1e9) if fault is not None and fault.kind == "delay" else 0
        due_ns = max(answer.due_ns, now_ns) + delay_ns
        if due_ns > now_ns:
            self._count += 1
            heapq.heappush(self._late, (due_ns, self._count, connection, answer, fault))
        else:
            self._reply(connection, answer, fault, now_ns)

    def _keep_back(self, fault: WireFault, connection: Connection, request: bytes) -> None:
        """Do what a fault says that keeps the request from the device, for good or for now."""
        if fault.kind == "late":
            self._count += 1
            due_ns = self._clock_ns() + round(fault.delay_s * 1e9)
            heapq.heappush(self._undone, (due_ns, self._count, connection, request))
        elif fault.kind == "unplug":
            self._unplug()
        elif fault.kind == "reset":
            self._drop(connection, reset=True)
        elif fault.kind == "exception":
            refusal = connection.wire.refusal(request)
            if refusal is not None and refusal.data is not None:
                self._send(connection, connection.wire.encode(refusal.data))

    def _unplug(self) -> None:
        """Fall silent for good, wherever faults happen."""
        for connection in [each for each in self._connections if each.faulty]:
            self._connections.remove(connection)
            self._selector.unregister(connection)
            connection.unplug()
            self._unplugged.append(connection)
        for listener in self._listeners:
            self._selector.unregister(listener)
        self._unplugged += self._listeners
        self._listeners.clear()

    def _carry_out_due(self, now_ns: int) -> None:
        """Execute what was put off, though its host may have gone since."""
        while self._undone and self._undone[0][0] <= now_ns:
            _, _, connection, request = heapq.heappop(self._undone)
            answer = connection.wire.answer(request, now_ns)
            if answer is not None and connection in self._connections:
                self._reply(connection, answer, None, now_ns)

    def _send_due(self, now_ns: int) -> None:
        while self._late and self._late[0][0] <= now_ns:
            _, _, connection, answer, fault = heapq.heappop(self._late)
            if connection in self._connections:
                self._reply(connection, answer, fault, now_ns)

    def _reply(
        self, connection: Connection, answer: EmulatedReply, fault: WireFault | None, now_ns: int
    ) -> None:
        data = answer.make(now_ns) if answer.make is not None else answer.data
        if data is None:
            return
        if fault is not None and fault.kind == "wrong_id" and answer.wrong_id is not None:
            data = answer.wrong_id(data)
        framed = connection.wire.encode(data)
        if fault is not None:
            framed = spoil(fault.kind, framed, connection.wire.corrupt_at(framed))
        self._send(connection, framed)

    def _send(self, connection: Connection, data: bytes) -> None:
        connection.send(data)
        if connection.unsent:
            self._selector.modify(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
