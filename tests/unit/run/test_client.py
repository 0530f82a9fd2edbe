"""Runs from outside: which one is meant, what it is asked, and what is not even sent."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run import client
from hilctl.run.client import (
    assigned,
    find_run,
    going_on,
    mark_run,
    set_run,
    status_of,
    stop_runs,
)
from tests.fakes import SteppingClock


def run(name, *, supervised=True, alive=True):
    card = SimpleNamespace(name=name, recording="a.mcap", supervisor=1, started=0.0)
    return SimpleNamespace(
        card=card, supervised=supervised, alive=alive, socket=f"{name}.sock", ring=Path("none")
    )


@pytest.fixture
def going(monkeypatch):
    """Let these runs be going on."""
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
def test_a_run_is_found_by_its_name_or_the_beginning_of_it(going, name, found):
    """A whole name goes before the beginning of another."""
    going("sine", "sine-2", "triangle")
    assert find_run(name).card.name == found


def test_what_is_not_one_run_is_refused_with_those_there_are(going):
    going("sine-1", "sine-2")
    with pytest.raises(InputError, match=r"more than one run is meant.*sine-1, sine-2"):
        find_run(None)
    with pytest.raises(InputError, match=r"no run is named 'x' \(going on: sine-1, sine-2\)"):
        find_run("x")
    going()
    with pytest.raises(InputError, match=r"^no run is going on$"):
        find_run(None)


def test_status_is_given_of_runs_that_do_not_answer(answers, monkeypatch):
    """A supervisor that hangs, one that died before its loop, and a run that is dead."""
    assert status_of(run("a"))["command"] == "status"
    dead, left = run("a", supervised=False, alive=False), run("a", supervised=False)
    assert status_of(dead) == {"name": "a", "state": "dead"}
    assert status_of(left)["state"] == "ramping down without its supervisor"

    def silent(socket, message):
        raise RunError("no answer")

    monkeypatch.setattr(client, "ask", silent)
    assert status_of(run("a")) == {"name": "a", "state": "not answering", "error": "no answer"}


def test_all_runs_are_requested_to_stop_before_one_is_waited_for(answers, monkeypatch):
    """Each says whether it has ended within the time for all, and what kept it from being asked."""
    done, clock = [], SteppingClock()
    chosen = [run("a"), run("b"), run("c"), run("d", alive=False)]

    def request(each):
        done.append(each.card.name)
        if each.card.name == "c":
            raise RunError("c: can't be stopped: no right")
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
        ("c", False, "c: can't be stopped: no right"),
        ("d", True, ""),
    ]
    assert answers == []


def test_only_runs_with_a_supervisor_are_going_on(monkeypatch):
    found = [run("a"), run("b", supervised=False)]
    monkeypatch.setattr(client, "runs", lambda: found)
    assert going_on() == found[:1]


def test_set_sends_what_is_to_change(answers):
    set_run(run("a"), **assigned(["gain=0.5", "offset=-2"]), over_s=1.5)
    set_run(run("a"), **assigned(["inverse=out"]))
    first, second = answers
    assert first == ("a.sock", {"command": "set", "gain": 0.5, "offset": -2.0, "over_s": 1.5})
    assert second == ("a.sock", {"command": "set", "inverse": "out", "over_s": 1.0})


def test_mark_sends_its_text(answers):
    mark_run(run("a"), "tapped the stage")
    assert answers == [("a.sock", {"command": "mark", "text": "tapped the stage"})]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gain", "must be gain=NUMBER, offset=NUMBER or inverse=in.out: 'gain'"),
        ("rate=1", "must be gain=NUMBER"),
        ("gain=high", "gain must be a number: 'high'"),
        ("inverse=0", "inverse must be in or out: '0'"),
    ],
)
def test_what_is_no_setting_is_refused(text, said):
    with pytest.raises(InputError, match=said):
        assigned(["offset=1", text])
