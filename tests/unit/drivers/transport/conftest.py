"""A peer of a TCP link, and a pty, for the tests of links."""

import os
import pty
import socket
import threading
import tty
from contextlib import contextmanager

import pytest

from hilctl_drivers.profile_base import SerialLineSettings
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.tcp import TcpLink

REPLY = b"0123456789"
PATIENT_S = 5.0
QUICK_S = 0.05


def missing(received):
    return max(0, len(REPLY) - len(received))


class Peer:
    """A TCP server that does one thing with its first connection, in a thread of its own."""

    def __init__(self, act):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self._act = act
        self.done = threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        connection, _ = self.server.accept()
        with connection:
            self._act(connection)
            self.done.wait(10.0)

    def stop(self):
        self.done.set()
        self.thread.join()
        self.server.close()


@pytest.fixture
def serve():
    """Return a function that starts a peer and returns its port."""
    peers = []

    def start(act):
        peers.append(Peer(act))
        return peers[-1].port

    yield start
    for peer in peers:
        peer.stop()


def line_settings(**changes):
    return SerialLineSettings(**{"kind": "serial", "baud": 9600, **changes})


def tcp(port, timeout_s=PATIENT_S):
    link = TcpLink("127.0.0.1", port, timeout_s)
    link.open()
    return link


def serial(path, timeout_s=PATIENT_S, **settings):
    """Return an open link to a line that is silent."""
    link = SerialLink(path, line_settings(**settings), timeout_s)
    link.open()
    link.drain()
    return link


@contextmanager
def answering(master, *replies):
    """Answer one request for each reply, at the far end of a line."""

    def answer():
        for reply in replies:
            os.read(master, 100)
            os.write(master, reply)

    thread = threading.Thread(target=answer)
    thread.start()
    yield
    thread.join()


@pytest.fixture
def line():
    """Yield the far end of a pty and the device file of the near end."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)
