"""A TCP link against a peer in a thread: pieces, silence, resets, and one name for each address."""

import socket
import struct
import threading
import time

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.links import LostError, NoAnswerError
from hilctl_drivers.transport.tcp import TcpLink, TcpReceiver
from tests.unit.drivers.transport.conftest import PATIENT_S, QUICK_S, REPLY, missing, tcp


def test_tcp_reply_in_pieces_is_put_together(serve):
    def act(connection):
        connection.recv(100)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for k in range(len(REPLY)):
            connection.sendall(REPLY[k : k + 1])

    link = tcp(serve(act))
    assert link.transact(b"ask", missing) == REPLY
    link.close()
    link.close()


def test_a_reply_that_came_while_the_host_stalled_is_read(serve):
    now, go, came = [0.0], threading.Event(), threading.Event()

    def act(connection):
        connection.recv(100)
        connection.sendall(REPLY[:4])
        go.wait(PATIENT_S)
        connection.sendall(REPLY[4:])
        came.set()

    link = TcpLink("127.0.0.1", serve(act), PATIENT_S, clock=lambda: now[0])
    link.open()

    def late(got):
        if got and not go.is_set():
            go.set()
            came.wait(PATIENT_S)
            now[0] += 10.0
        return missing(got)

    assert link.transact(b"ask", late) == REPLY
    link.close()


@pytest.mark.parametrize(
    ("sent", "words"), [(b"", "no answer within 0.05 s"), (b"0123", "only 4 bytes, 6 short")]
)
def test_tcp_silence_ends_at_the_deadline(serve, sent, words):
    def act(connection):
        connection.recv(100)
        connection.sendall(sent)

    link = tcp(serve(act), QUICK_S)
    with pytest.raises(NoAnswerError, match=words):
        link.transact(b"ask", missing)
    with pytest.raises(LostError, match="not connected"):
        link.transact(b"ask", missing)


def test_tcp_request_that_was_not_answered_is_given_up(serve):
    """The peer sees a reset: what it has not been given yet must not reach it later."""
    seen, acted = [], threading.Event()

    def act(connection):
        connection.recv(100)
        try:
            connection.recv(100)
        except ConnectionResetError as error:
            seen.append(error)
        acted.set()

    link = tcp(serve(act), QUICK_S)
    with pytest.raises(NoAnswerError):
        link.transact(b"ask", missing)
    assert acted.wait(PATIENT_S)
    assert len(seen) == 1


def test_tcp_kernel_sends_at_once_and_gives_up_in_time(serve):
    link = tcp(serve(lambda connection: None), QUICK_S)
    found = link._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
    assert found == round(QUICK_S * 1e3)
    assert link._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    link.close()


def test_tcp_address_of_the_peer_is_known_once_it_was_reached(serve):
    link = TcpLink("localhost", serve(lambda connection: None), PATIENT_S)
    assert link._host == "localhost"
    link.open()
    assert link._host == "127.0.0.1"
    link.close()


def test_tcp_trickle_does_not_move_the_deadline():
    ours, theirs = socket.socketpair()
    theirs.sendall(b"012")
    times = iter([0.0, 1.1])
    link = TcpLink("", 0, 1.0, clock=lambda: next(times))
    link._socket = ours
    with pytest.raises(NoAnswerError, match="within 1 s"):
        link.transact(b"ask", lambda received: 1)
    theirs.close()


def test_tcp_reset_closing_and_refusal_are_told_apart(serve):
    def reset(connection):
        connection.recv(100)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()

    def hang_up(connection):
        connection.recv(100)
        connection.shutdown(socket.SHUT_RDWR)

    with pytest.raises(LostError, match="reset by peer"):
        tcp(serve(reset)).transact(b"ask", missing)
    with pytest.raises(LostError, match="closed by the"):
        tcp(serve(hang_up)).transact(b"ask", missing)
    with pytest.raises(LostError, match="connection refused"):
        tcp(1)


def test_tcp_unknown_host_is_one_line():
    with pytest.raises(LostError, match="cannot connect"):
        TcpLink("host.invalid", 502, QUICK_S).open()


def test_tcp_frame_error_closes_the_connection(serve):
    """When the reply cannot be one, what else is on its way must not be taken for the next."""

    def act(connection):
        connection.recv(100)
        connection.sendall(REPLY)

    def refuse(received):
        if received:
            raise DeviceError("not a reply")
        return 1

    link = tcp(serve(act))
    with pytest.raises(DeviceError, match="not a reply"):
        link.transact(b"ask", refuse)
    with pytest.raises(LostError):
        link.transact(b"ask", missing)


def test_unasked_data_is_received_without_waiting(serve):
    go = threading.Event()

    def act(connection):
        go.wait(PATIENT_S)
        connection.sendall(REPLY)
        connection.shutdown(socket.SHUT_WR)

    receiver = TcpReceiver("127.0.0.1", serve(act), PATIENT_S)
    with pytest.raises(LostError):
        receiver.receive()
    opened_ns = time.monotonic_ns()
    receiver.open()
    assert receiver.receive()[0] == b""
    go.set()
    assert receiver.wait(PATIENT_S)
    data, age_ns = receiver.receive()
    assert data == REPLY
    assert 0 < age_ns <= time.monotonic_ns() - opened_ns
    assert receiver.wait(PATIENT_S)
    with pytest.raises(LostError, match="closed by the device"):
        receiver.receive()
    receiver.close()
