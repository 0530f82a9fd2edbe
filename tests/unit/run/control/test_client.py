"""Runs from outside: selection of a run, requests to it, and the signal that stops it."""

import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run.control import client
from hilctl.run.control.client import (
    STOP_SIGNAL,
    ask,
    assigned,
    find_run,
    finish_dead_runs,
    request_stop,
    status_of,
    stop_runs,
)
from hilctl.run.recovery import RecoveredRun
from tests.fakes import SteppingClock


def run(name, *, supervised=True, alive=True, recorded=False):
    card = SimpleNamespace(name=name, recording="a.mcap", supervisor=1, started=0.0)
    return SimpleNamespace(
        card=card, supervised=supervised, alive=alive, recorded=recorded,
        socket=f"{name}.sock", ring=Path("none"),
    )  # fmt: skip


@pytest.fixture
def going(monkeypatch):
    """Return a function that makes runs active."""
    return lambda *names: monkeypatch.setattr(client, "runs", lambda: [run(n) for n in names])


@pytest.fixture
def answers(monkeypatch):
    """Answer every question with a copy of it; return the questions."""
    sent = []

    def ask(socket, message, **more):
        sent.append((socket, message))
        return dict(message)

    monkeypatch.setattr(client, "ask", ask)
    monkeypatch.setattr(client, "facts_of", lambda run: {"name": run.card.name})
    return sent


@pytest.mark.parametrize(
    ("name", "found"), [("sine", "sine"), ("sine-", "sine-2"), ("tri", "triangle")]
)
def test_run_is_found_by_its_name_or_a_prefix(going, name, found):
    going("sine", "sine-2", "triangle")
    assert find_run(name).card.name == found


def test_ambiguous_run_is_refused_with_the_names(going):
    going("sine-1", "sine-2")
    with pytest.raises(InputError, match="sine-1, sine-2"):
        find_run(None)
    with pytest.raises(InputError, match="sine-1, sine-2"):
        find_run("x")
    going()
    with pytest.raises(InputError, match="active"):
        find_run(None)


def test_status_of_runs_that_do_not_answer(answers, monkeypatch):
    assert status_of(run("a"))["command"] == "status"
    dead, left = run("a", supervised=False, alive=False), run("a", supervised=False)
    assert status_of(dead) == {"name": "a", "state": "dead"}
    assert status_of(left)["state"] == "ramping down without its supervisor"
    unsafe = status_of(run("a", supervised=False, alive=False, recorded=True))
    assert (unsafe["state"], unsafe["output_state"]) == ("dead", "unknown")

    monkeypatch.setattr(client, "ask", Mock(side_effect=RunError("no answer")))
    assert status_of(run("a")) == {"name": "a", "state": "not answering", "error": "no answer"}


def test_all_runs_are_stopped_before_waiting_for_one(answers, monkeypatch):
    done, clock = [], SteppingClock()
    chosen = [run("a"), run("b"), run("c"), run("d", alive=False)]

    def request(each):
        done.append(each.card.name)
        if each.card.name == "c":
            raise RunError("c: cannot be stopped: no right")
        return each.card.name != "b"

    def sleep(seconds):
        done.append("sleep")
        clock.now += seconds
        chosen[0].alive = False

    monkeypatch.setattr(client, "request_stop", request)
    stopped = stop_runs(chosen, 0.05, clock, sleep)
    assert done[:5] == ["a", "b", "c", "d", "sleep"]
    assert 2 <= done.count("sleep") <= 3
    assert [(each["name"], each["ended"], each["error"]) for each in stopped] == [
        ("a", True, ""),
        ("b", False, "its supervisor is gone"),
        ("c", False, "c: cannot be stopped: no right"),
        ("d", True, ""),
    ]
    assert answers == []


@pytest.mark.parametrize(("text", "said"), [
    ("gain", "must be gain=NUMBER, offset=NUMBER or inverse=in.out: 'gain'"),
    ("rate=1", "must be gain=NUMBER"),
    ("gain=high", "gain must be a number: 'high'"),
    ("gain=1_0", "gain must be a number: '1_0'"),
    ("inverse=0", "inverse must be in or out: '0'"),
    ("offset=2", "offset is given twice"),
    ("x.rate=1", "x.gain=NUMBER"),
    ("x.gain=high", "x.gain must be a number"),
])  # fmt: skip
def test_invalid_assignments_are_refused(text, said):
    with pytest.raises(InputError, match=said):
        assigned(["offset=1", text])


def test_assignments_of_axes_have_their_names():
    assert assigned(["gain=1", "x.gain=0.5", "x.inverse=out", "y.offset=2"]) == {
        "gain": 1.0,
        "axes": {"x": {"gain": 0.5, "inverse": "out"}, "y": {"offset": 2.0}},
    }
    with pytest.raises(InputError, match=r"x\.gain is given twice"):
        assigned(["x.gain=1", "gain=1", "x.gain=1"])


def test_a_dropped_request_is_sent_again(tmp_path):
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
        with pytest.raises(RunError, match="protocol 9"):
            ask(path, {"say": "hello"})
        thread.join(10)
        serving(2)
        with pytest.raises(RunError, match="clients"):
            ask(path, {"say": "hello"}, 5.0, SteppingClock(2.0))
        thread.join(10)
        assert not thread.is_alive()


@pytest.fixture
def process():
    """A process that ends at the first signal."""
    # What this process ignores, its children do too, until they say otherwise.
    code = (
        f"import signal; signal.signal({STOP_SIGNAL}, signal.SIG_DFL); print(flush=True); input()"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert started.stdout is not None
    started.stdout.readline()
    yield started
    started.kill()
    started.communicate()


def run_of(number, *, supervised=True):
    card = SimpleNamespace(name="a", supervisor=number)
    return SimpleNamespace(card=card, supervised=supervised, alive=False)


def test_the_supervisor_gets_the_signal(process):
    assert request_stop(run_of(process.pid))
    assert process.wait(timeout=60) == -STOP_SIGNAL


def test_a_process_that_holds_no_lock_is_left_alone(process):
    """Another program may have its process id."""
    assert not request_stop(run_of(process.pid, supervised=False))
    assert process.poll() is None


def test_lock_is_checked_after_the_process_is_opened(process, monkeypatch):
    """In the other order, the process id could be reused in between."""
    order = []
    opened = os.pidfd_open

    class Going:
        card = SimpleNamespace(name="a", supervisor=process.pid)
        alive = False

        @property
        def supervised(self):
            order.append("lock")
            return True

    monkeypatch.setattr(os, "pidfd_open", lambda pid: order.append("process") or opened(pid))
    request_stop(Going())
    assert order == ["process", "lock"]


def test_a_supervisor_that_is_gone_is_no_error(process):
    process.kill()
    process.wait()
    assert not request_stop(run_of(process.pid))


def test_refused_signal_is_an_error(process, monkeypatch):
    monkeypatch.setattr(
        signal, "pidfd_send_signal", Mock(side_effect=PermissionError(1, "Operation not permitted"))
    )
    with pytest.raises(RunError, match="not permitted"):
        request_stop(run_of(process.pid))


@pytest.fixture
def recovered(monkeypatch):
    """Return a function that recovers dead runs with a given result."""

    def finish(result, *found):
        monkeypatch.setattr("hilctl.run.recovery.recover_dead_runs", lambda: [result])
        monkeypatch.setattr(client, "runs", lambda: found)
        finish_dead_runs()

    return finish


DEAD = run("sine-7", supervised=False, alive=False)


def test_recovery_is_logged(recovered, caplog):
    result = RecoveredRun("sine-7", Path("a.mcap"), safe=False, text="supervisor and loop died")
    recovered(result, run("a"), run("b", supervised=False, recorded=True))
    assert caplog.messages == []  # one has a supervisor, the other a guardian alone
    recovered(result, run("a"), DEAD)
    assert caplog.messages == [
        "sine-7 was not recorded to its end: supervisor and loop died",
        "recovered into a.mcap",
    ]
