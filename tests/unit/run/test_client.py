"""Runs from outside: which one is meant, what it is asked, and what is not even sent."""

from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run import client
from hilctl.run.client import find_run, free_log, set_run, status_of, stop_run


def run(name, *, supervised=True, alive=True):
    card = SimpleNamespace(name=name, recording="a.mcap", supervisor=1, started=0.0)
    return SimpleNamespace(card=card, supervised=supervised, alive=alive, socket=f"{name}.sock")


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
    with pytest.raises(InputError, match=r"no run is going on \(going on: none\)"):
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


def test_stop_says_whether_the_run_has_ended(answers):
    assert stop_run(run("a", alive=False), 0.0)["ended"] is True
    assert stop_run(run("a"), 0.0)["ended"] is False
    assert answers == [("a.sock", {"command": "stop"})] * 2


def test_set_sends_numbers(answers):
    set_run(run("a"), ["gain=0.5", "offset=-2"], 1.5)
    (sent,) = answers
    assert sent == ("a.sock", {"command": "set", "gain": 0.5, "offset": -2.0, "over_s": 1.5})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gain", "must be gain=NUMBER or offset=NUMBER: 'gain'"),
        ("rate=1", "must be gain=NUMBER"),
        ("gain=high", "gain must be a number: 'high'"),
    ],
)
def test_what_is_no_setting_is_not_sent(answers, text, said):
    with pytest.raises(InputError, match=said):
        set_run(run("a"), ["offset=1", text], 1.0)
    assert answers == []


def test_no_log_takes_the_place_of_another_file(tmp_path):
    """Neither one of another run, nor a user's own, nor a link that leads nowhere."""
    output = tmp_path / "run.mcap"
    assert free_log(output) == tmp_path / "run.log"
    (tmp_path / "run.log").write_text("mine")
    (tmp_path / "run.2.log").symlink_to(tmp_path / "nowhere")
    assert free_log(output) == tmp_path / "run.3.log"
