"""The control socket: who may ask, and what becomes of bad questions."""

import errno
import json
import shutil
import socket
import stat
import threading
from typing import ClassVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.errors import InputError, RunError
from hilctl.run.control_socket import ControlServer, ask
from hilctl.run.protocol import MAX_BYTES, VERSION
from tests.fakes import SteppingClock


class Later:
    """An answer that comes when the test has set it."""

    made: ClassVar[list] = []

    def __init__(self):
        self.found = None
        self.made.append(self)

    def answer(self):
        if isinstance(self.found, Exception):
            raise self.found
        return self.found


def echo(line):
    if line == b"refuse":
        raise InputError("not today")
    if line.startswith(b"later"):
        return Later()
    return {"heard": line.decode(errors="replace")}


@pytest.fixture
def server(tmp_path):
    with ControlServer(tmp_path / "socket", echo, SteppingClock()) as made:
        yield made


def connect(tmp_path):
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(tmp_path / "socket"))
    client.settimeout(5.0)
    return client


def exchange(server, tmp_path, raw):
    """Send bytes, close the sending side, and return what comes back."""
    server.serve(0.0)
    with connect(tmp_path) as client:
        client.sendall(raw)
        client.shutdown(socket.SHUT_WR)
        for _ in range(4):
            server.serve(0.0)
        return client.recv(100_000)


def test_only_its_owner_may_use_it(server, tmp_path):
    """The socket's mode is 0600, whatever the umask."""
    assert stat.S_IMODE((tmp_path / "socket").stat().st_mode) == 0o600


def test_it_listens_again_where_its_folder_was_removed(tmp_path):
    """As at a log-out; not in a folder that others can write."""
    path = tmp_path / "runs" / "sine-7" / "socket"
    path.parent.mkdir(parents=True, mode=0o700)
    path.parent.parent.chmod(0o700)
    with ControlServer(path, echo, SteppingClock()) as server:
        shutil.rmtree(path.parent.parent)
        path.parent.parent.mkdir()
        path.parent.parent.chmod(0o777)
        server.serve(0.0)
        assert not path.exists()
        path.parent.parent.chmod(0o700)
        assert json.loads(exchange(server, path.parent, b"hello"))["heard"] == "hello"


def test_question_and_answer_are_one_line_each(server, tmp_path):
    """A question is answered once its line is complete, and the connection is closed."""
    with connect(tmp_path) as client:
        client.sendall(b"hel")
        server.serve(0.0)
        client.sendall(b"lo\n")
        for _ in range(3):
            server.serve(0.0)
        assert json.loads(client.recv(1000)) == {"protocol": VERSION, "ok": True, "heard": "hello"}
        assert client.recv(1000) == b""


def test_a_question_without_its_end_is_one_when_its_client_has_said_all(server, tmp_path):
    assert json.loads(exchange(server, tmp_path, b"hello")) == {
        "protocol": VERSION,
        "ok": True,
        "heard": "hello",
    }


def test_refusal_is_told_in_words(server, tmp_path):
    """What can't be followed comes back as an error text."""
    answer = json.loads(exchange(server, tmp_path, b"refuse\n"))
    assert answer == {"protocol": VERSION, "ok": False, "error": "not today"}


def test_endless_question_is_cut_off(server, tmp_path):
    """Nobody can fill the memory."""
    with connect(tmp_path) as client:
        client.sendall(b"x" * (MAX_BYTES + 100))
        for _ in range(4):
            server.serve(0.0)
        answer = json.loads(client.recv(1000))
    assert (answer["ok"], answer["error"]) == (False, f"longer than {MAX_BYTES} bytes")


def test_silent_client_is_dropped(tmp_path):
    """Who connects and says nothing holds nobody up, and is sent away after half a second."""
    clock = SteppingClock()
    with ControlServer(tmp_path / "socket", echo, clock) as server, connect(tmp_path) as client:
        server.serve(0.0)
        clock.now = 0.4
        server.serve(0.0)
        client.setblocking(False)
        with pytest.raises(BlockingIOError):
            client.recv(10)
        clock.now = 0.6
        server.serve(0.0)
        assert client.recv(10) == b""


def closed(client):
    """Return whether the server has closed a connection, without waiting."""
    client.setblocking(False)
    try:
        return client.recv(10) == b""
    except BlockingIOError:
        return False


def test_the_longest_silent_make_room_for_who_has_something_to_ask(server, tmp_path):
    """However many say nothing, a question is answered at once."""
    crowd = [connect(tmp_path) for _ in range(80)]
    server.serve(0.0)
    server.serve(0.0)
    with connect(tmp_path) as client:
        client.sendall(b"hello\n")
        server.serve(0.0)
        assert json.loads(client.recv(1000))["ok"]
    gone = [closed(each) for each in crowd]
    assert gone == sorted(gone, reverse=True)
    assert gone.count(True) == 80 - 63
    crowd[-1].setblocking(True)
    crowd[-1].sendall(b"hello\n")
    server.serve(0.0)
    assert json.loads(crowd[-1].recv(1000))["ok"]
    for client in crowd:
        client.close()


def test_a_crowd_is_taken_in_one_go(server, tmp_path):
    """The queue of those who wait to be let in never fills while it is served."""
    for _ in range(4):
        crowd = [connect(tmp_path) for _ in range(60)]
        server.serve(0.0)
        for client in crowd:
            client.close()
    server.serve(0.0)
    assert json.loads(exchange(server, tmp_path, b"hello\n"))["ok"]


def test_a_question_that_was_sent_at_once_is_not_pushed_out(server, tmp_path):
    """Whoever comes after it in the same moment does not take its place."""
    with connect(tmp_path) as client:
        client.sendall(b"hello\n")
        crowd = [connect(tmp_path) for _ in range(100)]
        for _ in range(3):
            server.serve(0.0)
        assert json.loads(client.recv(1000))["ok"]
        for each in crowd:
            each.close()


def test_without_descriptors_the_longest_silent_goes(server, tmp_path, monkeypatch):
    """Else the one who asks would wait for as long as the others stay."""
    silent, other = connect(tmp_path), connect(tmp_path)
    server.serve(0.0)

    def full(self):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket.socket, "accept", full)
    waiting = connect(tmp_path)
    server.serve(0.0)
    assert closed(silent)
    assert not closed(other)
    for each in (silent, other, waiting):
        each.close()


def test_what_takes_time_is_answered_later_while_others_are_served(server, tmp_path):
    """Neither silence nor a closed sending side ends the wait, and nobody takes its place."""
    with connect(tmp_path) as first, connect(tmp_path) as second:
        first.sendall(b"later\n")
        first.shutdown(socket.SHUT_WR)
        second.sendall(b"later\n")
        server.serve(0.0)
        server._clock.now += 100.0
        crowd = [connect(tmp_path) for _ in range(80)]
        server.serve(0.0)
        server.serve(0.0)
        assert json.loads(exchange(server, tmp_path, b"hello\n"))["ok"]
        Later.made[-2].found, Later.made[-1].found = {"n": 1}, InputError("no")
        server.serve(0.0)
        assert json.loads(first.recv(1000)) == {"protocol": VERSION, "ok": True, "n": 1}
        refused = {"protocol": VERSION, "ok": False, "error": "no"}
        assert json.loads(second.recv(1000)) == refused
        assert (first.recv(10), second.recv(10)) == (b"", b"")
        for each in crowd:
            each.close()


def test_who_has_left_before_the_answer_is_no_error(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"later\n")
        server.serve(0.0)
    Later.made[-1].found = {"n": 1}
    server.serve(0.0)
    assert json.loads(exchange(server, tmp_path, b"hello\n"))["ok"]


def test_a_later_answer_is_looked_for_within_the_wait(tmp_path):
    """Not only when the wait is over."""
    clock = SteppingClock()
    with ControlServer(tmp_path / "socket", echo, clock) as server, connect(tmp_path) as client:
        client.sendall(b"later\n")
        server.serve(0.0)
        waits = []
        select = server._selector.select

        def shown(timeout):
            waits.append(timeout)
            clock.now += timeout
            return select(0.0)

        server._selector.select = shown
        server.serve(0.02)
        assert max(waits) <= 0.005
        Later.made[-1].found = {}
        server.serve(0.0)
        server.serve(0.02)
        assert max(waits) == pytest.approx(0.02)


def test_another_user_is_sent_away(server, tmp_path, monkeypatch):
    monkeypatch.setattr("os.getuid", lambda: 4242)
    monkeypatch.setattr("hilctl.run.control_socket._is_ours", lambda connection: False)
    with connect(tmp_path) as client:
        client.sendall(b"hello\n")
        server.serve(0.0)
        with pytest.raises(ConnectionResetError):
            client.recv(10)


@settings(max_examples=200)
@given(st.binary(max_size=300))
def test_any_bytes_are_answered_or_dropped(tmp_path_factory, raw):
    """Nothing that a client sends makes the server raise or hang."""
    folder = tmp_path_factory.mktemp("control")
    with ControlServer(folder / "socket", echo, SteppingClock()) as server:
        answer = exchange(server, folder, raw)
        assert answer == b"" or "ok" in json.loads(answer)
        assert json.loads(exchange(server, folder, b"still there\n"))["ok"]


def test_ask_brings_answer_or_error(tmp_path):
    """The client's side: answers as mappings, refusals and silence as errors of ours."""
    path = tmp_path / "socket"
    with ControlServer(path, lambda line: echo(json.loads(line)["say"].encode())) as server:
        over = threading.Event()

        def serve():
            while not over.is_set():
                server.serve(0.01)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            assert ask(path, {"say": "hello"}) == {"heard": "hello"}
            with pytest.raises(InputError, match="not today"):
                ask(path, {"say": "refuse"})
        finally:
            over.set()
            thread.join()
    with pytest.raises(RunError, match="does not answer"):
        ask(path, {"say": "hello"})


def test_a_question_that_was_pushed_out_is_asked_again(tmp_path):
    """Until the time is up; a connection that was cut before it had an answer has done nothing."""
    path = tmp_path / "socket"
    seen = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen(20)

        def serve(connections, last):
            for number in range(1, connections + 1):
                client, _ = listener.accept()
                with client:
                    if number % 2 == 0:
                        seen.append(client.recv(1000))
                    if number == connections:
                        client.sendall(last)

        def serving(connections, last=b""):
            # A daemon: one that waits in vain must not keep the tests from ending.
            thread = threading.Thread(target=serve, args=(connections, last), daemon=True)
            thread.start()
            return thread

        thread = serving(6, b'{"protocol": 1, "ok": true, "n": 1}\n')
        assert ask(path, {"say": "hello"}) == {"n": 1}
        thread.join(10)
        assert seen == [b'{"say": "hello"}\n'] * 3
        thread = serving(2, b'{"protocol": 9, "ok": false, "error": "set: ..."}\n')
        with pytest.raises(RunError, match="speaks protocol 9, this hilctl 1"):
            ask(path, {"say": "hello"})
        thread.join(10)
        serving(2)
        with pytest.raises(RunError, match="among a crowd"):
            ask(path, {"say": "hello"}, 5.0, SteppingClock(2.0))
        thread.join(10)
        assert not thread.is_alive()


def test_path_that_cannot_be_listened_at_is_told(tmp_path):
    """A socket that can't be made is an error of ours."""
    with pytest.raises(RunError, match="can't listen"):
        ControlServer(tmp_path / ("x" * 200), echo)
    assert list(tmp_path.iterdir()) == []
