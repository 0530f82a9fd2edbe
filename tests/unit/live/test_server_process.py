"""Processes of the servers."""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from hilctl.base.errors import RunError
from hilctl.live import server_process
from hilctl.live.server_process import SingleRun, served_beside
from tests.fakes import SteppingClock


def runs(feed):
    return SimpleNamespace(feed=lambda name: feed)


def test_server_ends_some_time_after_its_last_run():
    clock = SteppingClock()
    over = SingleRun(clock)
    ended, active = (runs(SimpleNamespace(ended=value)) for value in (True, False))
    assert not any(over(each) for each in (runs(None), active, ended, active))
    clock.now = 5.0
    assert not over(ended)
    clock.now = 6.4
    assert not over(ended)
    clock.now = 6.6
    assert over(ended)


@pytest.fixture
def beside(monkeypatch):
    """Return a function that replaces the server by a program and returns the processes."""
    started, popen = [], subprocess.Popen

    def take_place(code):
        def start(command, **settings):
            started.append(popen([sys.executable, "-c", code], **settings))
            return started[-1]

        names = {name: getattr(subprocess, name) for name in ("PIPE", "TimeoutExpired")}
        monkeypatch.setattr(server_process, "subprocess", SimpleNamespace(Popen=start, **names))
        monkeypatch.setattr(server_process, "_LAST_S", 0.05)
        monkeypatch.setattr(server_process, "_START_S", 0.05)
        return started

    yield take_place
    for process in started:
        process.kill()
        process.wait()


def test_suspended_server_does_not_delay_the_run(beside, monkeypatch):
    started = beside("print('http://here', flush=True); input(); input()")
    monkeypatch.setattr(server_process, "_START_S", 60.0)
    with served_beside() as url:
        assert url == "http://here"
        os.kill(started[0].pid, signal.SIGSTOP)
    assert started[0].wait(60) == -signal.SIGKILL


def test_server_without_address_is_killed(beside):
    started = beside("input(); input()")
    with pytest.raises(RunError), served_beside():
        pass
    assert started[0].wait(60) < 0
