"""Bytes over TCP and ptys: whole replies, deadlines, and clear words about what went wrong."""

import os
import pty
import select
import threading
import tty

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.links import (
    LostError,
    NoAnswerError,
)
from hilctl_drivers.transport.serial_port import SerialLink, SerialSettings
from tests.fakes import received
from tests.unit.drivers.transport.conftest import (
    PATIENT_S,
    QUICK_S,
    REPLY,
    answering,
    missing,
    serial,
    tcp,
)


def test_no_reply_wanted_is_not_waited_for(serve, line):
    """A command that is not answered costs no time-out, on either link."""
    for link in (tcp(serve(lambda connection: None)), serial(line[1])):
        assert link.transact(b"tell", lambda received: 0) == b""
        link.close()


@pytest.mark.parametrize(
    ("sent", "words"), [(b"", "no answer within 0.3 s"), (b"0123", "only 4 bytes, 6 short")]
)
def test_a_known_size_moves_no_deadline(serve, line, sent, words):
    """Silence and cut replies end in time too where the size of a good reply is known."""

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
    """Shorter, longer, and longer than what is read at once: what comes is what is returned."""
    sent = bytes(size)

    def act(connection):
        connection.recv(100)
        connection.sendall(sent)

    link = tcp(serve(act))
    assert link.transact(b"ask", lambda got: size - len(got), len(REPLY)) == sent
    link.close()


def test_full_serial_line_times_out(line):
    """Nobody takes what is sent: an error in time, not a hang."""
    link = serial(line[1], QUICK_S)
    for request in (bytes(1_000_000), b"ask"):
        with pytest.raises(NoAnswerError, match="not send within"):
            link.transact(request, missing)
    link.close()


def test_serial_exchanges(line):
    """What is written gets there, and a reply that is waiting in pieces is put together."""
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
    """A second one can't have the port, and is told so."""
    first, second = serial(line[1]), SerialLink(line[1], SerialSettings(), QUICK_S)
    with pytest.raises(LostError, match=r"can't be opened: .*lock"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_serial_late_reply_is_thrown_away(line):
    """After a time-out, what still comes is not taken for the answer to the next request."""
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
    """A doubled reply is noticed before the next request is sent."""
    master, name = line
    link = serial(name)
    os.write(master, REPLY)
    select.select([link._fd], [], [], PATIENT_S)
    with pytest.raises(DeviceError, match="10 bytes that"):
        link.transact(b"ask", missing)
    link.close()


def test_serial_gap_is_kept(line):
    """The next request waits until the line has been quiet for the gap."""
    master, name = line
    now, slept = [10.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    settings = SerialSettings(9600, gap_s=0.004, boot_s=2.0)
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
    """A port that goes away in mid-exchange is told so, and is closed."""
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
    """A port that is not there is a device error with the system's own words."""
    link = SerialLink("/dev/no_such_port", SerialSettings(), QUICK_S)
    with pytest.raises(LostError, match="No such file"):
        link.open()


def test_serial_chatter_does_not_hang(line):
    """A line that never gets quiet is an error within bounds."""
    _, name = line
    times = iter(range(1000))
    link = SerialLink(name, SerialSettings(), 1.0, clock=lambda: float(next(times)))
    link.open()
    link._read = lambda: b"x"
    link._poll = type("Always", (), {"poll": lambda self, ms: [1]})()
    with pytest.raises(DeviceError, match="get quiet"):
        link.transact(b"ask", missing)
    link.close()
