"""The control socket: who may ask, and what becomes of bad questions."""

import json
import socket
import stat
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.errors import InputError, RunError
from hilctl.run.control_socket import MAX_BYTES, ControlServer, ask
from tests.fakes import SteppingClock


def echo(line):
    if line == b"refuse":
        raise InputError("not today")
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
    with connect(tmp_path) as client:
        client.sendall(raw)
        client.shutdown(socket.SHUT_WR)
        for _ in range(4):
            server.serve(0.0)
        return client.recv(100_000)


def test_only_its_owner_may_use_it(server, tmp_path):
    """The socket's mode is 0600, whatever the umask."""
    assert stat.S_IMODE((tmp_path / "socket").stat().st_mode) == 0o600


def test_question_and_answer_are_one_line_each(server, tmp_path):
    """A question is answered once its line is complete, and the connection is closed."""
    with connect(tmp_path) as client:
        client.sendall(b"hel")
        server.serve(0.0)
        client.sendall(b"lo\n")
        for _ in range(3):
            server.serve(0.0)
        assert json.loads(client.recv(1000)) == {"ok": True, "heard": "hello"}
        assert client.recv(1000) == b""


def test_refusal_is_told_in_words(server, tmp_path):
    """What can't be followed comes back as an error text."""
    answer = json.loads(exchange(server, tmp_path, b"refuse\n"))
    assert answer == {"ok": False, "error": "not today"}


def test_endless_question_is_cut_off(server, tmp_path):
    """Nobody can fill the memory."""
    with connect(tmp_path) as client:
        client.sendall(b"x" * (MAX_BYTES + 100))
        for _ in range(4):
            server.serve(0.0)
        answer = json.loads(client.recv(1000))
    assert answer == {"ok": False, "error": f"longer than {MAX_BYTES} bytes"}


def test_silent_client_is_dropped(tmp_path):
    """Who connects and says nothing holds nobody up, and is sent away after a second."""
    clock = SteppingClock()
    with ControlServer(tmp_path / "socket", echo, clock) as server, connect(tmp_path) as client:
        server.serve(0.0)
        clock.now = 0.9
        server.serve(0.0)
        client.setblocking(False)
        with pytest.raises(BlockingIOError):
            client.recv(10)
        clock.now = 1.1
        server.serve(0.0)
        assert client.recv(10) == b""


def test_crowd_is_sent_away(server, tmp_path):
    """More clients than there is room for are refused, and the ones there are still served."""
    crowd = [connect(tmp_path) for _ in range(9)]
    for _ in range(12):
        server.serve(0.0)
    crowd[0].sendall(b"hello\n")
    server.serve(0.0)
    assert json.loads(crowd[0].recv(1000))["ok"]
    assert crowd[8].recv(10) == b""
    for client in crowd:
        client.close()


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


def test_path_that_cannot_be_listened_at_is_told(tmp_path):
    """A socket that can't be made is an error of ours."""
    with pytest.raises(RunError, match="can't listen"):
        ControlServer(tmp_path / ("x" * 200), echo)
    assert list(tmp_path.iterdir()) == []
