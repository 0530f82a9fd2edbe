"""A loop's process that waits for its job: over a socket, with the locks."""

import os
import socket
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.run import waiting_loop as module
from hilctl.run.waiting_loop import WaitingLoop, received_job, started_ahead, taken


class FakeProcess:
    """Notes how it was started, and keeps its end of the connection."""

    def __init__(self, command, *, stdin, stderr, start_new_session):
        self.command, self.errors, self.alone = command, stderr, start_new_session
        self.stdin = os.dup(stdin)
        self.ended = []

    def kill(self):
        self.ended.append("kill")

    def wait(self, timeout_s):
        self.ended.append("wait")


@pytest.fixture
def waiting(monkeypatch):
    doubles = SimpleNamespace(
        Popen=FakeProcess, DEVNULL=-3, TimeoutExpired=subprocess.TimeoutExpired
    )
    monkeypatch.setattr(module, "subprocess", doubles)
    return WaitingLoop()


def descriptors_of(path):
    links = Path("/proc/self/fd").iterdir()
    return [int(link.name) for link in links if os.path.realpath(link) == str(path)]


def test_a_job_comes_whole_and_brings_the_locks(waiting, tmp_path):
    """Also where a process that was forked meanwhile has the sender's end too."""
    path = tmp_path / "lock"
    job = b"\x00\xff\n" * 20_000
    with path.open("w") as lock, waiting._socket.dup():
        process = waiting.give(job, [lock.fileno()])
        lock.close()
        assert received_job(process.stdin) == job
    assert process.alone
    (held,) = descriptors_of(path)  # and it is open still, with the connection closed
    os.close(held)


def test_its_errors_are_the_runs_from_the_job_on(waiting, tmp_path, monkeypatch):
    """Before, nobody is told: the supervisor meets the same, and says it in words."""
    assert waiting._process.errors == -3
    mine = (tmp_path / "errors").open("w+")
    theirs = os.open(os.devnull, os.O_WRONLY)
    monkeypatch.setattr(module, "_ERRORS", mine.fileno())
    process = waiting.give(b"p{}", [])
    monkeypatch.setattr(module, "_ERRORS", theirs)
    assert received_job(process.stdin) == b"p{}"
    os.write(theirs, b"broken")
    os.close(theirs)
    assert mine.seek(0) == 0
    assert mine.read() == "broken"
    mine.close()


def test_a_run_without_standard_error_has_a_loop_without(waiting, monkeypatch):
    monkeypatch.setattr(module, "_ERRORS", 10_000)
    process = waiting.give(b"p{}", [])
    assert received_job(process.stdin) == b"p{}"


def test_a_loop_that_died_is_seen_later(waiting):
    """What could not be sent is no error here: the supervisor asks how it ended."""
    os.close(waiting._process.stdin)
    assert waiting.give(b"p{}", []) is waiting._process


def test_a_loop_that_hangs_takes_no_job_and_is_seen_later(waiting, monkeypatch):
    """It does not read: the supervisor must still hear the user."""
    monkeypatch.setattr(module, "_GIVE_S", 0.01)
    assert waiting.give(bytes(10**7), []) is waiting._process


def test_where_no_job_comes_there_is_none():
    ours, theirs = socket.socketpair()
    ours.close()
    assert received_job(theirs.detach()) == b""


def test_one_that_nobody_takes_is_ended(waiting, monkeypatch):
    """A run that was refused leaves no process."""
    os.close(waiting._process.stdin)
    made = []
    monkeypatch.setattr(module, "WaitingLoop", lambda: made.append(waiting) or waiting)
    with started_ahead(), started_ahead():
        pass
    assert len(made) == 1
    assert waiting._process.ended == ["kill", "wait"]
    assert not module._ahead


def test_one_that_was_started_ahead_is_its_takers(waiting, monkeypatch):
    os.close(waiting._process.stdin)
    made = []
    monkeypatch.setattr(module, "WaitingLoop", lambda: made.append(waiting) or waiting)
    with started_ahead():
        assert taken() is waiting
    assert waiting._process.ended == []
    assert len(made) == 1
    assert taken() is waiting
    assert len(made) == 2
    waiting.discard()


@pytest.mark.slow
def test_a_process_without_a_job_ends_by_itself():
    """Its supervisor died: nobody else is there to end it."""
    loop = WaitingLoop()
    loop._socket.close()
    assert loop._process.wait(60) == 0
