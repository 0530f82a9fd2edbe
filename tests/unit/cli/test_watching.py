"""Looking on a run: by name, and beside the process that supervises it."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from hilctl.base.errors import RunError
from hilctl.cli import watching


@pytest.fixture
def run(monkeypatch):
    """A run that is watched without a screen, for as long as the test says."""
    made = SimpleNamespace(card=SimpleNamespace(name="demo-7", supervisor=7))
    feed = SimpleNamespace(ended=True, status=lambda: {"state": "stopped", "reason": "by hand"})
    monkeypatch.setattr(watching, "find_run", lambda name: made)
    monkeypatch.setattr(watching, "RunFeed", lambda folder: feed)
    made.feed = feed
    looked = SimpleNamespace(run=lambda: None)
    monkeypatch.setattr(watching, "Watcher", lambda *given: looked)
    made.looked = looked
    return made


def test_the_end_of_a_run_is_said(run, capsys):
    watching.watch("demo")
    assert capsys.readouterr().out == "demo-7: stopped: by hand\n"


def test_who_leaves_is_told_that_the_run_goes_on(run, capsys):
    run.feed.ended = False
    watching.watch(None)

    def interrupted():
        raise KeyboardInterrupt

    run.looked.run = interrupted
    watching.watch(None)
    assert capsys.readouterr().out == "demo-7 goes on: hilctl watch, hilctl stop\n" * 2


def test_a_process_beside_shows_the_run_of_its_parent_only(run, monkeypatch):
    """It waits for that to appear, and for no other; without a parent it ends."""
    other = SimpleNamespace(card=SimpleNamespace(name="x", supervisor=8))
    run.description = SimpleNamespace(exists=lambda: True)
    found, seen = iter([[], [other], [other, run]]), []
    monkeypatch.setattr(watching, "runs", lambda: next(found))
    monkeypatch.setattr(watching.os, "getppid", lambda: 7)
    monkeypatch.setattr(watching.time, "sleep", lambda s: None)
    monkeypatch.setattr(watching.signal, "signal", lambda *given: None)
    monkeypatch.setattr(watching, "_watched", lambda run: seen.append(run) or "over")
    monkeypatch.setattr(sys, "argv", ["watching", "7"])
    watching.main()
    assert seen == [run]
    monkeypatch.setattr(watching.os, "getppid", lambda: 1)
    watching.main()
    assert seen == [run]


def test_a_run_that_can_not_be_looked_at_is_said(run, monkeypatch, capsys):
    def refuse(folder):
        raise RunError("demo-7: can't be looked at")

    monkeypatch.setattr(watching, "_watched", refuse)
    watching._shown_once(run)
    assert "can't be looked at" in capsys.readouterr().err


def test_who_leaves_the_view_beside_a_run_is_told_how_to_end_it(run, capsys):
    run.feed.ended = False
    watching._shown_once(run)
    assert "Ctrl-C ends it" in capsys.readouterr().out


@pytest.mark.parametrize("ignores", ["", "signal.signal(15, signal.SIG_IGN);"])
def test_what_stands_beside_a_run_ends_with_it(monkeypatch, ignores):
    """By itself; where its terminal stands still, it is ended."""
    monkeypatch.setattr(watching, "_END_S", 0.2)
    started = []

    class Started(subprocess.Popen):
        def __init__(self, command):
            code = f"import signal, time; {ignores} print(flush=True); time.sleep(60)"
            super().__init__([sys.executable, "-c", code], stdout=subprocess.PIPE)
            self.stdout.readline()
            started.append((command, self))

    monkeypatch.setattr(subprocess, "Popen", Started)
    with watching.watched_beside():
        assert started[0][1].poll() is None
    ((command, process),) = started
    assert command[-2:] == ["hilctl.cli.watching", str(watching.os.getpid())]
    assert process.returncode == (-9 if ignores else -15)
