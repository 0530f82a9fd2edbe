"""Emulated devices over sockets, asked by independent clients."""

import os
import select
import socket
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from hilctl_drivers.emulator.options import parse_fault
from hilctl_drivers.emulator.server import EmulatorServer
from hilctl_drivers.emulator.wire import EmulatedReply, EmulatedWire
from hilctl_drivers.modbus.pdu import read_pdu, tcp_adu, write_pdu
from hilctl_drivers.modbus.register_map import RegisterFormat
from tests.fakes import logged, received

FLOAT32 = RegisterFormat("float32")
MS = 1_000_000


class EchoWire(EmulatedWire):
    """A wire whose requests are single bytes; each is answered by itself, 10 ms later if late."""

    def __init__(self, *, late=False, size=1):
        self._late, self._size = late, size

    def requests(self, received):
        while received:
            yield bytes([received.pop(0)])

    def answer(self, request, now_ns):
        return EmulatedReply(self._size * request, now_ns + 10 * MS if self._late else 0)

    def refusal(self, request):
        return EmulatedReply(b"!")

    def written(self, request):
        return {request.decode()}


class Served:
    """A server that runs in a thread, in a time that the test makes pass, and its ptys."""

    def __init__(self, faults, wires):
        self.now_ns = 0
        self._server = EmulatorServer([parse_fault(text) for text in faults], lambda: self.now_ns)
        names = [self._server.open_pty(wire, faulty=not i) for i, wire in enumerate(wires)]
        self.ports = [os.open(name, os.O_RDWR | os.O_NOCTTY) for name in names]
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()

    def ask(self, data, which=0, timeout_s=5.0):
        """Return what comes within the time; nothing where the line is dead."""
        os.write(self.ports[which], data)
        ready, _, _ = select.select([self.ports[which]], [], [], timeout_s)
        return os.read(self.ports[which], 1000) if ready else None

    def close(self):
        self._server.stop()
        self._thread.join()
        for port in self.ports:
            os.close(port)


@pytest.fixture
def serving():
    """Return a function that serves wires at ptys."""
    with ExitStack() as stack:

        def start(*wires, faults=()):
            made = Served(faults, wires)
            stack.callback(made.close)
            return made

        yield start


def test_faults_happen_on_the_first_line_only(serving):
    server = serving(EchoWire(), EchoWire(), faults=["exception@2"])
    assert [server.ask(b"a", which) for which in (1, 0, 1, 0, 0)] == [b"a", b"a", b"a", b"!", b"a"]


def test_one_output_may_refuse(serving):
    server = serving(EchoWire(), faults=["y:exception@2"])
    assert [server.ask(data) for data in (b"y", b"x", b"y", b"x", b"y")] == [
        b"y", b"x", b"!", b"x", b"!",
    ]  # fmt: skip


def test_an_unplugged_line_is_gone_and_the_other_stays(serving):
    server = serving(EchoWire(), EchoWire(), faults=["unplug@1"])
    os.write(server.ports[0], b"a")
    select.select([server.ports[0]], [], [], 5.0)
    assert os.read(server.ports[0], 10) == b""
    assert server.ask(b"b", which=1) == b"b"


def test_a_late_answer_is_given_up_with_the_next_request(serving):
    server = serving(EchoWire(late=True))
    os.write(server.ports[0], b"ab")
    while (got := server.ask(b"", timeout_s=0.0)) is None:
        server.now_ns += 10 * MS
    assert got == b"b"


def test_what_the_host_does_not_read_waits_for_room(serving):
    server = serving(EchoWire(size=100_000), EchoWire())
    os.write(server.ports[0], b"ab")
    assert server.ask(b"c", which=1) == b"c"
    assert received(server.ports[0], 200_000) == 100_000 * b"a" + 100_000 * b"b"


def test_late_request_is_carried_out_after_its_host_has_gone(served, tmp_path):
    path = tmp_path / "log.jsonl"
    faults = (parse_fault("late:0.2@1"),)
    host, port = served("labjack_t7", log=path, faults=faults, command=0.0).split(":")
    for value in (3.0, 2.0):
        data = FLOAT32.encode(value)
        with socket.create_connection((host, int(port)), 5.0) as link:
            link.sendall(tcp_adu(1, 1, write_pdu(1000, data)))
            if value == 2.0:
                assert link.recv(100)
    for _ in range(500):
        written = [event["value"] for event in logged(path)]
        if len(written) == 2:
            break
        threading.Event().wait(0.01)
    assert written == [2.0, 3.0]


def test_a_reset_is_not_a_hang_up(served):
    host, port = served("labjack_t7", faults=(parse_fault("reset@1"),)).split(":")
    with socket.create_connection((host, int(port)), 5.0) as link:
        link.sendall(tcp_adu(1, 1, read_pdu(3, 1000, 2)))
        with pytest.raises(ConnectionResetError):
            link.recv(100)


def test_no_other_device_gets_the_name_of_an_unplugged_line(serving):
    """A host that opens it again must not reach another device."""
    server = serving(EchoWire(), faults=["unplug@1"])
    name = os.ttyname(server.ports[0])
    os.write(server.ports[0], b"a")
    select.select([server.ports[0]], [], [], 5.0)
    assert os.read(server.ports[0], 10) == b""
    master, slave = os.openpty()
    assert not Path(name).exists()
    assert os.ttyname(slave) != name
    os.close(master)
    os.close(slave)
