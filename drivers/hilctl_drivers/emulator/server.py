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
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from hilctl.base.errors import InputError
from hilctl.base.files import ADDRESS_REMEDIES, reason
from hilctl_drivers.emulator.options import FaultPlan, WireFault, spoil
from hilctl_drivers.emulator.sensor_stream import PERIOD_NS, EmulatedStream
from hilctl_drivers.emulator.wire import EmulatedReply, EmulatedWire

_CHUNK = 65536


class _Connection:
    """A host's connection to a wire, by a descriptor that does not block."""

    def __init__(self, fd: int, wire: EmulatedWire, *, faulty: bool) -> None:
        self._fd = fd
        self.wire = wire
        self.faulty = faulty  # whether the server's faults happen here
        self.received = bytearray()  # no complete request yet
        self.received_ns = 0
        self.unsent = bytearray()  # waits for room, as in a USB device's buffer

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self._fd

    def read(self) -> bytes | None:
        """Return the received bytes; None if the host has closed the connection."""
        try:
            return os.read(self._fd, _CHUNK) or None
        except BlockingIOError:
            return b""
        except OSError:  # a crashed host counts as disconnected
            return None

    def send(self, data: bytes) -> None:
        """Send as much as fits; the next call sends the rest."""
        self.unsent += data
        with suppress(OSError):  # no room, or the host has gone
            while self.unsent:
                del self.unsent[: os.write(self._fd, self.unsent)]

    def unplug(self) -> None:
        """Stay silent permanently; :meth:`close` is still called."""

    def close(self, *, reset: bool = False) -> None:
        """Close the connection, or break it."""


class _TcpConnection(_Connection):
    """An accepted connection; a pulled network cable closes nothing."""

    def __init__(self, connection: socket.socket, wire: EmulatedWire) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        super().__init__(connection.fileno(), wire, faulty=True)
        self._connection = connection

    def close(self, *, reset: bool = False) -> None:
        if reset:
            linger = struct.pack("ii", 1, 0)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self._connection.close()


class _UdpConnection(_Connection):
    """Datagrams to a host, which may not listen."""

    def __init__(self, wire: EmulatedWire, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect((host, port))
        super().__init__(self._socket.fileno(), wire, faulty=True)

    def read(self) -> bytes | None:
        return super().read() or b""

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            os.write(self._fd, data)

    def close(self, *, reset: bool = False) -> None:
        self._socket.close()


class _PtyConnection(_Connection):
    """Connection to the program at the other end of a pty; there is nothing to reset."""

    def __init__(self, wire: EmulatedWire, *, faulty: bool) -> None:
        # Kept open, so that the line does not end when a host closes it.
        master, self._slave = pty.openpty()
        super().__init__(master, wire, faulty=faulty)
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(master, False)
        self.name = os.ttyname(self._slave)

    def unplug(self) -> None:
        os.close(self._fd)  # a pulled adapter takes its port along
        self._fd = -1

    def close(self, *, reset: bool = False) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        # Last: until then no other pty gets its name, which a host may still be trying.
        os.close(self._slave)


class _Scheduled(NamedTuple):
    """An action and its time; the next request on ``superseded_by`` cancels it."""

    due_ns: int
    number: int
    action: Callable[[int], None]
    superseded_by: _Connection | None


_TICK_S = 0.005
_STALE_NS = 1_000_000_000  # a busy machine may deliver one write in parts


class EmulatorServer:
    """Answers requests until it is stopped."""

    def __init__(
        self, faults: Sequence[WireFault] = (), clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._plan = FaultPlan(faults)
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._selector = selectors.DefaultSelector()
        self._wires: list[EmulatedWire] = []
        self._listeners: dict[socket.socket, EmulatedWire] = {}
        self._connections: list[_Connection] = []
        self._unplugged: list[_Connection | socket.socket] = []
        self._scheduled: list[_Scheduled] = []
        self._count = 0
        self._stopping = False

    def listen_tcp(self, wire: EmulatedWire, host: str, port: int) -> str:
        """Listen at a port, or a free one if 0; raise InputError if it is in use."""
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            why = reason(error, ADDRESS_REMEDIES)
            raise InputError(f"cannot listen on {host}:{port}: {why}") from None
        self._listeners[listener] = wire
        self._wires.append(wire)
        self._selector.register(listener, selectors.EVENT_READ)
        self._begin_stream(wire)
        return f"{host}:{listener.getsockname()[1]}"

    def send_udp(self, wire: EmulatedWire, host: str, port: int) -> str:
        """Send a stream to a UDP port, or to a free one if 0."""
        if not port:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind((host, 0))
                port = free.getsockname()[1]
        self._add(_UdpConnection(wire, host, port))
        self._wires.append(wire)
        self._begin_stream(wire)
        return f"{host}:{port}"

    def _begin_stream(self, wire: EmulatedWire) -> None:
        if isinstance(wire, EmulatedStream):
            self._push(wire, self._clock_ns())

    def open_pty(self, wire: EmulatedWire, *, faulty: bool = True) -> str:
        """Open a pty and return the device file of its other end."""
        connection = _PtyConnection(wire, faulty=faulty)
        self._wires.append(wire)
        self._add(connection)
        self._begin_stream(wire)
        return connection.name

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        while not self._stopping:
            for key, events in self._selector.select(self._pause_s()):
                self._serve(key.fileobj, events)
            now_ns = self._clock_ns()
            for wire in self._wires:
                wire.tick(now_ns)
            while self._scheduled and self._scheduled[0].due_ns <= now_ns:
                heapq.heappop(self._scheduled).action(now_ns)
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
        if not self._scheduled:
            return _TICK_S
        return min(_TICK_S, max(0.0, (self._scheduled[0].due_ns - self._clock_ns()) * 1e-9))

    def _serve(self, source: object, events: int) -> None:
        if source in self._listeners:
            assert isinstance(source, socket.socket)
            self._add(_TcpConnection(source.accept()[0], self._listeners[source]))
        elif source in self._connections:  # otherwise it was closed since
            assert isinstance(source, _Connection)
            if events & selectors.EVENT_WRITE:
                self._selector.modify(source, selectors.EVENT_READ)
                self._send(source, b"")
            if events & selectors.EVENT_READ:
                self._receive(source)

    def _add(self, connection: _Connection) -> None:
        self._connections.append(connection)
        self._selector.register(connection, selectors.EVENT_READ)

    def _drop(self, connection: _Connection, *, reset: bool = False) -> None:
        self._connections.remove(connection)
        self._selector.unregister(connection)
        connection.close(reset=reset)

    def _receive(self, connection: _Connection) -> None:
        data = connection.read()
        if data is None:
            self._drop(connection)
            return
        now_ns = self._clock_ns()
        if now_ns - connection.received_ns > _STALE_NS:
            connection.received.clear()  # an abandoned partial request
        connection.received_ns = now_ns
        connection.received += data
        for request in connection.wire.requests(connection.received):
            self._answer(connection, request)
            if connection not in self._connections:
                return

    def _push(self, wire: EmulatedStream, now_ns: int) -> None:
        """Send a stream's next block to the hosts that read, and schedule the one after it."""
        data = wire.block(now_ns)
        for connection in self._connections:
            if connection.wire is wire and not connection.unsent:
                self._send(connection, data)
        self._schedule(now_ns + PERIOD_NS, partial(self._push, wire))

    def _schedule(
        self, due_ns: int, action: Callable[[int], None], superseded_by: _Connection | None = None
    ) -> None:
        self._count += 1
        heapq.heappush(self._scheduled, _Scheduled(due_ns, self._count, action, superseded_by))

    def _answer(self, connection: _Connection, request: bytes) -> None:
        now_ns = self._clock_ns()
        # A new request means that the host no longer waits for earlier replies.
        self._scheduled = [e for e in self._scheduled if e.superseded_by is not connection]
        heapq.heapify(self._scheduled)
        fault = None
        if connection.faulty:
            written = partial(connection.wire.written, request)
            fault = self._plan.next((now_ns - self._start_ns) * 1e-9, written)
        if fault is not None and fault.kind == "invalid":
            for wire in self._wires:
                wire.mark_invalid(now_ns + round(fault.delay_s * 1e9))
        if fault is not None and fault.kind == "stall":
            for wire in self._wires:
                if isinstance(wire, EmulatedStream):
                    wire.stalled_until_ns = now_ns + round(fault.delay_s * 1e9)
        if fault is not None and fault.kind in {"silence", "unplug", "reset", "exception", "late"}:
            self._keep_back(fault, connection, request)
        else:
            self._execute(connection, request, fault, now_ns)

    def _execute(
        self, connection: _Connection, request: bytes, fault: WireFault | None, now_ns: int
    ) -> None:
        """Execute a request, though its host may have gone; reply now or when it is due."""
        answer = connection.wire.answer(request, now_ns)
        if answer is None:
            return
        delay_ns = round(fault.delay_s * 1e9) if fault is not None and fault.kind == "delay" else 0
        due_ns = max(answer.due_ns, now_ns) + delay_ns
        reply = partial(self._reply, connection, answer, fault)
        if due_ns > now_ns:
            self._schedule(due_ns, reply, connection if fault is None else None)
        else:
            reply(now_ns)

    def _keep_back(self, fault: WireFault, connection: _Connection, request: bytes) -> None:
        """Withhold the request from the device, permanently or for a time."""
        if fault.kind == "late":
            due_ns = self._clock_ns() + round(fault.delay_s * 1e9)
            self._schedule(due_ns, partial(self._execute, connection, request, None))
        elif fault.kind == "unplug":
            self._unplug()
        elif fault.kind == "reset":
            self._drop(connection, reset=True)
        elif fault.kind == "exception":
            refusal = connection.wire.refusal(request)
            if refusal is not None and refusal.data is not None:
                self._send(connection, connection.wire.encode(refusal.data))

    def _unplug(self) -> None:
        """Stay silent permanently on connections with faults."""
        for connection in [each for each in self._connections if each.faulty]:
            self._connections.remove(connection)
            self._selector.unregister(connection)
            connection.unplug()
            self._unplugged.append(connection)
        for listener in self._listeners:
            self._selector.unregister(listener)
        self._unplugged += self._listeners
        self._listeners.clear()

    def _reply(
        self, connection: _Connection, answer: EmulatedReply, fault: WireFault | None, now_ns: int
    ) -> None:
        if connection not in self._connections:
            return
        data = answer.make(now_ns) if answer.make is not None else answer.data
        if data is None:
            return
        if fault is not None and fault.kind == "wrong_id" and answer.wrong_id is not None:
            data = answer.wrong_id(data)
        framed = connection.wire.encode(data)
        if fault is not None:
            framed = spoil(fault.kind, framed, connection.wire.corrupt_at(framed))
        self._send(connection, framed)

    def _send(self, connection: _Connection, data: bytes) -> None:
        connection.send(data)
        if connection.unsent:
            self._selector.modify(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
