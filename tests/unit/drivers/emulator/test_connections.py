"""Connections of an emulator: what has not come, what does not fit, and hosts that are gone."""

import os
import select
import socket
from pathlib import Path

import pytest

from hilctl_drivers.emulator.connections import PtyConnection, TcpConnection
from tests.fakes import received


@pytest.fixture
def tcp():
    """Both ends of a connection over TCP."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        host = socket.create_connection(server.getsockname(), 5.0)
        connection = TcpConnection(server.accept()[0], None)
        yield host, connection
        host.close()
        connection.close()


def test_tcp_hands_on_what_comes_and_tells_the_end(tcp):
    host, connection = tcp
    host.sendall(b"ask")
    assert connection.read() == b"ask"
    connection.send(b"answer")
    assert host.recv(100) == b"answer"
    host.close()
    assert connection.read() is None


def test_a_reset_is_not_a_hang_up(tcp):
    """The host sees a connection that broke, not one that was closed in order."""
    host, connection = tcp
    connection.close(reset=True)
    with pytest.raises(ConnectionResetError):
        host.recv(100)


@pytest.fixture
def pty():
    connection = PtyConnection(None, faulty=False)
    host = os.open(connection.name, os.O_RDWR | os.O_NOCTTY)
    yield host, connection
    os.close(host)
    connection.close()


def test_a_pty_waits_without_blocking_and_passes_all_bytes(pty):
    """Raw: no byte is a line end, a flow control or a signal."""
    host, connection = pty
    assert connection.read() == b""
    every = bytes(range(256))
    os.write(host, every)
    got = b""
    while len(got) < len(every) and select.select([connection], [], [], 5.0)[0]:
        got += connection.read()
    assert got == every
    connection.send(every)
    assert received(host, 256) == every


def test_what_a_host_does_not_read_waits(pty):
    """A full line blocks nobody; the rest goes with the next call."""
    host, connection = pty
    sent = os.urandom(1 << 20)
    connection.send(sent)
    assert 0 < len(connection.unsent) < len(sent)
    got = b""
    while len(got) < len(sent):
        got += os.read(host, 1 << 16)
        connection.send(b"")
    assert got == sent
    assert connection.unsent == b""


def test_nobody_else_gets_the_name_of_an_unplugged_line():
    """A host that tries it again must not reach another device."""
    pulled = PtyConnection(None, faulty=True)
    pulled.unplug()
    other = PtyConnection(None, faulty=True)
    try:
        assert not Path(pulled.name).exists()
        assert other.name != pulled.name
    finally:
        pulled.close()
        other.close()
