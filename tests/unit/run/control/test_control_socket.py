"""The control socket: permissions, bad requests, slow clients, and many clients at once."""

import json
import shutil
import socket
import stat
import threading
from contextlib import ExitStack
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.errors import InputError, RunError
from hilctl.run.control.client import MAX_BYTES, VERSION, ask
from hilctl.run.control.control_socket import ControlServer

PATIENT_S = 60.0


def echo(line):
    if line == b"refuse":
        raise InputError("not today")
    if line == b"break":
        raise ZeroDivisionError("a bug")
    return {"heard": line.decode(errors="replace")}


def serving(path, answer=echo, request_s=PATIENT_S):
    server = ControlServer(path, answer, request_s)
    server.start()
    return server


@pytest.fixture
def server(tmp_path):
    with serving(tmp_path / "socket") as made:
        yield made


def connect(folder):
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.settimeout(PATIENT_S)
    client.connect(str(folder / "socket"))
    return client


def answer_of(client):
    answer = bytearray()
    while data := client.recv(100_000):
        answer += data
    return bytes(answer)


def exchange(folder, raw):
    """Send bytes, close the sending side, and return the answer."""
    with connect(folder) as client:
        client.sendall(raw)
        client.shutdown(socket.SHUT_WR)
        return answer_of(client)


def test_only_its_owner_may_use_it(server, tmp_path):
    assert stat.S_IMODE((tmp_path / "socket").stat().st_mode) == 0o600


def test_it_listens_again_after_its_folder_was_removed(tmp_path):
    """As at a log-out; but not in a folder that others can write to."""
    path = tmp_path / "runs" / "sine-7" / "socket"
    path.parent.mkdir(parents=True, mode=0o700)
    path.parent.parent.chmod(0o700)
    with ControlServer(path, echo) as server:
        shutil.rmtree(path.parent.parent)
        path.parent.parent.mkdir()
        path.parent.parent.chmod(0o777)
        server._restore_socket()
        assert not path.exists()
        path.parent.parent.chmod(0o700)
        server._restore_socket()
        server.start()
        assert json.loads(exchange(path.parent, b"hello"))["heard"] == "hello"


def test_request_and_answer_are_one_line_each(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"hel")
        client.sendall(b"lo\n")
        assert json.loads(answer_of(client)) == {"protocol": VERSION, "ok": True, "heard": "hello"}


def test_the_end_of_the_stream_ends_a_request(server, tmp_path):
    assert json.loads(exchange(tmp_path, b"hello"))["heard"] == "hello"


def test_a_refusal_is_an_answer(server, tmp_path):
    answer = json.loads(exchange(tmp_path, b"refuse\n"))
    assert answer == {"protocol": VERSION, "ok": False, "error": "not today"}


def test_a_request_that_is_too_long_is_refused(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"x" * (MAX_BYTES + 100))
        answer = json.loads(client.recv(1000))
    assert (answer["ok"], answer["error"]) == (False, f"longer than {MAX_BYTES} bytes")
    assert json.loads(exchange(tmp_path, b"x" * MAX_BYTES + b"\n"))["ok"]


@pytest.mark.parametrize("sent", [b"", b"hel"])
def test_a_slow_client_is_dropped_without_an_answer(tmp_path, sent):
    with serving(tmp_path / "socket", request_s=1e-3), connect(tmp_path) as client:
        client.sendall(sent)
        assert answer_of(client) == b""


def test_silent_clients_leave_room_for_others(tmp_path):
    """More of them than may be connected at once."""
    with serving(tmp_path / "socket", request_s=0.01), ExitStack() as crowd:
        for _ in range(150):
            crowd.enter_context(connect(tmp_path))
        assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_an_answer_that_takes_time_delays_no_other(tmp_path):
    released = threading.Event()

    def answer(line):
        if line == b"slow":
            assert released.wait(PATIENT_S)
        return {}

    with serving(tmp_path / "socket", answer), connect(tmp_path) as slow:
        slow.sendall(b"slow\n")
        slow.shutdown(socket.SHUT_WR)
        assert json.loads(exchange(tmp_path, b"fast\n"))["ok"]
        released.set()
        assert json.loads(answer_of(slow))["ok"]


def test_a_client_that_has_left_is_no_error(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"hello\n")
    assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_an_error_of_one_request_ends_no_other(server, tmp_path, caplog):
    assert exchange(tmp_path, b"break\n") == b""
    assert "request failed" in caplog.text
    assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_clients_without_a_thread_cost_no_place(server, tmp_path, monkeypatch, caplog):
    with monkeypatch.context() as patch:
        patch.setattr(
            threading.Thread, "start", Mock(side_effect=RuntimeError("can't start new thread"))
        )
        for _ in range(70):
            with connect(tmp_path) as client:
                assert answer_of(client) == b""
    assert "request failed" in caplog.text
    assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_another_user_is_sent_away(server, tmp_path, monkeypatch):
    monkeypatch.setattr("hilctl.run.control.control_socket.is_same_user", lambda connection: False)
    with connect(tmp_path) as client:
        assert answer_of(client) == b""


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("control")
    with serving(folder / "socket"):
        yield folder


@settings(max_examples=200, deadline=None)
@given(raw=st.binary(max_size=300))
def test_any_bytes_are_answered_or_dropped(shared, raw):
    answer = exchange(shared, raw)
    assert answer == b"" or "ok" in json.loads(answer)
    assert json.loads(exchange(shared, b"still there\n"))["ok"]


def test_ask_returns_the_answer_or_raises(tmp_path):
    path = tmp_path / "socket"
    with serving(path, lambda line: echo(json.loads(line)["say"].encode())):
        assert ask(path, {"say": "hello"}) == {"heard": "hello"}
        with pytest.raises(InputError, match="not today"):
            ask(path, {"say": "refuse"})
    with pytest.raises(RunError, match="does not answer"):
        ask(path, {"say": "hello"})


def test_a_path_that_cannot_be_used_is_an_error(tmp_path):
    with pytest.raises(RunError, match="can't listen"):
        ControlServer(tmp_path / ("x" * 200), echo)
    assert list(tmp_path.iterdir()) == []
