"""Serves emulated Modbus devices over TCP and over ptys, with faults where they are wanted.

One thread and no locks: requests, the rig's time and the watchdogs take turns.
"""

import heapq
import selectors
import socket
import time
from collections.abc import Callable, Sequence

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.faults import Fault, FaultPlan, spoil
from hilctl_drivers.emulator.modbus_peers import Peer, PtyPeer, TcpPeer
from hilctl_drivers.emulator.modbus_wire import CORRUPT_AT, ModbusWire

TICK_S = 0.01
_STALE_NS = 50_000_000


class ModbusServer:
    """Answers requests until it is stopped.

    Args:
        faults: What goes wrong.
        mute: Functions that are never answered, as some devices do with those they don't know.
        clock_ns: Monotonic time.
    """

    def __init__(
        self,
        faults: Sequence[Fault] = (),
        mute: frozenset[int] = frozenset(),
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._plan = FaultPlan(faults)
        self._mute = mute
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._selector = selectors.DefaultSelector()
        self._wires: list[ModbusWire] = []
        self._listeners: dict[socket.socket, ModbusWire] = {}
        self._peers: list[Peer] = []
        self._late: list[tuple[int, int, Peer, bytes]] = []
        self._stopping = False

    def listen_tcp(self, wire: ModbusWire, host: str, port: int) -> int:
        """Listen; return the port, which is a free one where 0 is asked for.

        Raises:
            InputError: The port is in use or not ours to have.
        """
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            raise InputError(f"can't listen on {host}:{port}: {error.strerror}") from None
        self._listeners[listener] = wire
        self._wires.append(wire)
        self._selector.register(listener, selectors.EVENT_READ)
        return int(listener.getsockname()[1])

    def open_pty(self, wire: ModbusWire) -> str:
        """Open a pty and return the device file of its other end."""
        peer = PtyPeer(wire)
        self._wires.append(wire)
        self._add(peer)
        return peer.name

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        while not self._stopping:
            for key, _ in self._selector.select(self._pause_s()):
                self._serve(key.fileobj)
            now_ns = self._clock_ns()
            for wire in self._wires:
                wire.tick(now_ns)
            while self._late and self._late[0][0] <= now_ns:
                _, _, peer, reply = heapq.heappop(self._late)
                if peer in self._peers:
                    peer.send(reply)
        self.close()

    def stop(self) -> None:
        """Make :meth:`run` end; from any thread or signal handler."""
        self._stopping = True  # noticed at the next tick of the rig

    def _pause_s(self) -> float:
        if not self._late:
            return TICK_S
        return min(TICK_S, max(0.0, (self._late[0][0] - self._clock_ns()) * 1e-9))

    def _serve(self, who: object) -> None:
        if isinstance(who, socket.socket):
            self._add(TcpPeer(who.accept()[0], self._listeners[who]))
        elif isinstance(who, TcpPeer | PtyPeer) and who in self._peers:
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
            used, request = peer.wire.take(bytes(peer.received))
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
            peer.send(peer.wire.answer(request, now_ns))
        else:
            self._misbehave(fault, peer, request, now_ns)

    def _misbehave(self, fault: Fault, peer: Peer, request: bytes, now_ns: int) -> None:
        """Do what a fault says; those that keep the reply back keep the request back too."""
        if fault.kind == "unplug":
            self._unplug()
        elif fault.kind == "reset":
            self._drop(peer, reset=True)
        elif fault.kind == "exception":
            peer.send(peer.wire.refusal(request, 4))
        elif fault.kind != "silence":
            reply = peer.wire.answer(request, now_ns)
            if fault.kind == "wrong_id":
                reply = peer.wire.wrong_id(request, reply)
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
            if isinstance(peer, PtyPeer):
                self._drop(peer)
            else:
                self._selector.unregister(peer)
        for listener in self._listeners:
            self._selector.unregister(listener)

    def close(self) -> None:
        """Let go of everything, where it is not going to :meth:`run`."""
        for peer in self._peers:
            peer.close()
        self._peers.clear()
        for listener in self._listeners:
            listener.close()
        self._selector.close()
