"""Bytes over TCP and ptys: whole replies, deadlines, and clear words about what went wrong."""

import os
import pty
import select
import threading
import tty

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.links import LostError, NoAnswerError
from hilctl_drivers.transport.serial_port import SerialLink
from tests.fakes import received
from tests.unit.drivers.transport.conftest import (
    PATIENT_S,
    QUICK_S,
    REPLY,
    answering,
    line_settings,
    missing,
    serial,
    tcp,
)


def test_no_reply_wanted_is_not_waited_for(serve, line):
    for link in (tcp(serve(lambda connection: None)), serial(line[1])):
        assert link.transact(b"tell", lambda received: 0) == b""
        link.close()


@pytest.mark.parametrize(
    ("sent", "words"), [(b"", "no answer within 0.3 s"), (b"0123", "only 4 bytes, 6 short")]
)
def test_a_known_size_moves_no_deadline(serve, line, sent, words):
    def act(connection):
        connection.recv(100)
        connection.sendall(sent)

    master, name = line
    with answering(master, sent):
        for link in (tcp(serve(act), 0.3), serial(name, 0.3)):
            with pytest.raises(NoAnswerError, match=words):
                link.transact(b"ask", missing, len(REPLY))
            link.close()


@pytest.mark.parametrize("size", [9, 11, 300])
def test_a_reply_of_another_size_than_usual_is_asked_about(serve, size):
    sent = bytes(size)

    def act(connection):
        connection.recv(100)
        connection.sendall(sent)

    link = tcp(serve(act))
    assert link.transact(b"ask", lambda got: size - len(got), len(REPLY)) == sent
    link.close()


def test_full_serial_line_times_out(line):
    link = serial(line[1], QUICK_S)
    for request in (bytes(1_000_000), b"ask"):
        with pytest.raises(NoAnswerError, match="not send within"):
            link.transact(request, missing)
    link.close()


def test_serial_exchanges(line):
    master, name = line
    link = serial(name, baud=115200, parity="E")

    def answer():
        assert os.read(master, 100) == b"ask"
        os.write(master, REPLY[:4])
        os.write(master, REPLY[4:])

    thread = threading.Thread(target=answer)
    thread.start()
    assert link.transact(b"ask", missing) == REPLY
    thread.join()
    link.close()
    link.close()


def test_serial_port_is_ours_alone(line):
    first, second = serial(line[1]), SerialLink(line[1], line_settings(), QUICK_S)
    with pytest.raises(LostError, match=r"cannot be opened: .*lock"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_serial_late_reply_is_thrown_away(line):
    master, name = line
    link = serial(name, QUICK_S)
    with pytest.raises(NoAnswerError, match=r"no answer within"):
        link.transact(b"one", missing)
    os.write(master, b"late reply")
    with pytest.raises(NoAnswerError):
        link.transact(b"two", missing)
    assert received(master, 6) == b"onetwo"
    link.close()


def test_serial_unasked_bytes_are_refused(line):
    master, name = line
    link = serial(name)
    os.write(master, REPLY)
    select.select([link._fd], [], [], PATIENT_S)
    with pytest.raises(DeviceError, match="10 bytes that"):
        link.transact(b"ask", missing)
    link.close()


def test_serial_gap_is_kept(line):
    master, name = line
    now, slept = [10.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    settings = line_settings(gap_s=0.004, boot_wait_s=2.0)
    link = SerialLink(name, settings, 1.0, clock=lambda: now[0], sleep=sleep)
    link.open()
    assert slept == [2.0]
    link.drain()
    with answering(master, REPLY, REPLY):
        for _ in range(2):
            assert link.transact(b"ask", missing) == REPLY
    assert slept == [2.0, pytest.approx(0.004)]
    link.close()


def test_serial_unplugged_is_one_line():
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = serial(os.ttyname(slave))
    os.close(slave)
    thread = threading.Thread(target=lambda: (os.read(master, 3), os.close(master)))
    thread.start()
    with pytest.raises(LostError, match="port lost, unplugged"):
        link.transact(b"ask", missing)
    thread.join()
    with pytest.raises(LostError, match="not open"):
        link.transact(b"ask", missing)


def test_serial_missing_port_is_one_line():
    link = SerialLink("/dev/no_such_port", line_settings(), QUICK_S)
    with pytest.raises(LostError, match="No such file"):
        link.open()


def test_serial_chatter_does_not_hang(line):
    _, name = line
    times = iter(range(1000))
    link = SerialLink(name, line_settings(), 1.0, clock=lambda: float(next(times)))
    link.open()
    link._read = lambda: b"x"
    link._poll = type("Always", (), {"poll": lambda self, ms: [1]})()
    with pytest.raises(DeviceError, match="get quiet"):
        link.transact(b"ask", missing)
    link.close()
