"""Streams on ptys and TCP: what comes late, what comes back, and where the connection ends."""

import os
import socket
import struct
import threading
from contextlib import contextmanager, suppress

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.links import CorruptError, LostError, NoAnswerError
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.tcp import TcpStream
from tests.unit.drivers.transport.conftest import PATIENT_S, QUICK_S, REPLY, line_settings, missing


@contextmanager
def stream(act, timeout_s=PATIENT_S, **settings):
    """Yield an open TCP stream in step, whose peer runs ``act`` with its connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            connection, _ = server.accept()
            with connection:
                act(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        link = TcpStream("127.0.0.1", server.getsockname()[1], timeout_s, **settings)
        link.open()
        link.drain()
        yield link
        link.close()
        thread.join()


def answering(*replies):
    def act(connection):
        for reply in replies:
            connection.recv(100)
            connection.sendall(reply)
        with suppress(ConnectionResetError):
            connection.recv(100)  # until the host has closed it

    return act


def test_exchanges_over_tcp():
    with stream(answering(REPLY, REPLY, b"")) as link:
        assert link.is_in_step
        assert link.transact(b"ask", missing) == REPLY
        assert link.transact(b"ask", missing, len(REPLY)) == REPLY
        assert link.transact(b"tell", lambda got: 0) == b""


@pytest.mark.parametrize("usual", [0, len(REPLY)])
def test_a_request_sent_ahead_is_sent_once(usual):
    sent = []

    def act(connection):
        for _ in range(2):
            sent.append(connection.recv(100))
            connection.sendall(REPLY)
        connection.recv(100)

    with stream(act) as link:
        link.begin(b"ask")
        assert link.transact(b"ask", missing, usual) == REPLY
        assert link.transact(b"ask", missing, usual) == REPLY
    assert sent == [b"ask", b"ask"]


def test_the_reply_to_another_request_than_the_one_sent_ahead_is_discarded():
    replied = threading.Event()

    def act(connection):
        connection.recv(100)
        connection.sendall(b"late reply")
        replied.set()
        assert connection.recv(100) == b"two"
        connection.sendall(REPLY)
        connection.recv(100)

    with stream(act) as link:
        link.begin(b"one")
        replied.wait(PATIENT_S)
        assert link.transact(b"two", missing) == REPLY


def test_a_late_reply_is_discarded():
    received, late = threading.Event(), threading.Event()

    def act(connection):
        connection.recv(100)
        received.set()
        late.wait(PATIENT_S)
        connection.sendall(b"late reply")
        assert connection.recv(100) == b"two"
        connection.sendall(REPLY)
        connection.recv(100)

    with stream(act, QUICK_S) as link:
        with pytest.raises(NoAnswerError):
            link.transact(b"one", missing)
        assert not link.is_in_step
        late.set()
        link.timeout_s = PATIENT_S
        link.await_silence(QUICK_S, PATIENT_S)
        assert link.transact(b"two", missing) == REPLY


@pytest.mark.parametrize("pieces", [1, 3])
def test_an_echo_is_taken_off(pieces):
    whole = b"ask" + REPLY

    def act(connection):
        connection.recv(100)
        for k in range(pieces):
            connection.sendall(whole[k * len(whole) // pieces : (k + 1) * len(whole) // pieces])
        connection.recv(100)
        connection.sendall(b"tell")
        connection.recv(100)

    with stream(act, echo=True) as link:
        assert link.transact(b"ask", missing, len(REPLY)) == REPLY
        assert link.transact(b"tell", lambda got: 0) == b""


def test_an_echo_that_does_not_come_is_an_error():
    with (
        stream(answering(REPLY), echo=True) as link,
        pytest.raises(CorruptError, match="omit echo"),
    ):
        link.transact(b"ask", missing)


def test_an_echo_that_was_not_expected_is_named():
    """As of function 6 of Modbus, whose reply repeats the request."""
    echoed = threading.Event()

    def act(connection):
        connection.sendall(connection.recv(100))
        echoed.wait(PATIENT_S)
        connection.sendall(b"ask")
        with suppress(ConnectionResetError):
            connection.recv(100)

    with stream(act) as link:
        assert link.transact(b"ask", lambda got: 3 - len(got)) == b"ask"
        echoed.set()
        link._poll.poll(PATIENT_S * 1e3)
        with pytest.raises(DeviceError, match="echo: true"):
            link.transact(b"ask", missing)


def test_an_echo_without_an_answer_is_named():
    with stream(answering(b"ask"), QUICK_S) as link, pytest.raises(NoAnswerError, match="echo"):
        link.transact(b"ask", missing)


def test_the_end_of_a_connection_is_one_line():
    with (
        stream(lambda connection: connection.recv(3)) as link,
        pytest.raises(LostError, match="closed by the device"),
    ):
        link.transact(b"ask", missing)
    assert not link.is_open
    with pytest.raises(LostError, match="not open"):
        link.transact(b"ask", missing)

    def reset(connection):
        connection.recv(3)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    with stream(reset) as link, pytest.raises(LostError, match="connection lost: connection reset"):
        link.transact(b"ask", missing)


def test_a_request_that_was_not_answered_is_given_up():
    """The peer sees a reset: what it was not given yet must not reach it later."""
    seen = []

    def act(connection):
        connection.recv(100)
        try:
            connection.recv(100)
        except ConnectionResetError as error:
            seen.append(error)

    with stream(act, QUICK_S) as link, pytest.raises(NoAnswerError):
        link.transact(b"ask", missing)
    assert len(seen) == 1


def test_a_peer_that_reads_nothing_is_an_error_in_time():
    done = threading.Event()
    with stream(lambda connection: done.wait(PATIENT_S), QUICK_S) as link:
        with pytest.raises(NoAnswerError, match="not send within"):
            link.transact(bytes(20_000_000), missing)
        with pytest.raises(NoAnswerError, match="not send within"):
            link.send_now(b"safe")
        done.set()


def test_an_echo_on_a_line_is_taken_off(line):
    master, name = line
    link = SerialLink(name, line_settings(echo=True), PATIENT_S)
    link.open()
    link.drain()
    thread = threading.Thread(target=lambda: os.write(master, os.read(master, 100) + REPLY))
    thread.start()
    assert link.transact(b"ask", missing, len(REPLY)) == REPLY
    thread.join()
    link.close()


def test_a_port_without_an_rs485_mode_says_so(line):
    link = SerialLink(line[1], line_settings(rs485="high"), QUICK_S)
    with pytest.raises(LostError, match="omit rs485"):
        link.open()
