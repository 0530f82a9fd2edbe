"""Commands about runs that are going on: exit codes, and what programs read."""

import json

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.commands import load


def steer(name, words):
    return load(name)(words, standalone_mode=False) or 0


@pytest.fixture
def going(monkeypatch):
    """A run that answers as told."""

    class Card:
        name, recording = "sine-7", "a.mcap"

    class Going:
        card = Card

    monkeypatch.setattr("hilctl.cli.steering.find_run", lambda name: Going)
    return monkeypatch


def stopped(*, ended, name="sine-7"):
    return {"name": name, "recording": "a.mcap", "ended": ended, "error": ""}


def test_no_run_is_an_empty_list(capsys):
    assert steer("status", ["--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"runs": []}


def test_a_run_that_does_not_end_in_time_is_a_failure(going, capsys):
    going.setattr("hilctl.cli.steering.stop_runs", lambda runs, wait_s: [stopped(ended=False)])
    assert steer("stop", ["--wait", "2"]) == 3
    assert "sine-7 is still going after 2 s" in capsys.readouterr().out


def test_all_runs_are_stopped_and_each_is_told(going, capsys):
    """One that goes on is a failure; none at all is not."""
    chosen = []

    def stop_runs(runs, wait_s):
        chosen.append((runs, wait_s))
        return [stopped(ended=name == "a", name=name) for name in runs]

    going.setattr("hilctl.cli.steering.stop_runs", stop_runs)
    going.setattr("hilctl.cli.steering.going_on", lambda: ["a", "b"])
    assert steer("stop", ["--all", "--json"]) == 3
    assert [each["ended"] for each in json.loads(capsys.readouterr().out)["runs"]] == [True, False]
    going.setattr("hilctl.cli.steering.going_on", list)
    assert steer("stop", ["--all"]) == 0
    assert chosen == [(["a", "b"], 60.0), ([], 60.0)]
    with pytest.raises(InputError, match="--all and --run"):
        steer("stop", ["--all", "--run", "a"])


def test_set_says_what_was_taken(going, capsys):
    answer = {"gain": 0.5, "offset": -2.0, "over_s": 1.5, "inverse": None}
    asked = []

    def set_run(run, **wanted):
        asked.append(wanted)
        return answer

    going.setattr("hilctl.cli.steering.set_run", set_run)
    assert steer("set", ["gain=0.5", "offset=-2", "--over", "1.5"]) == 0
    assert "sine-7: gain 0.5, offset -2, over 1.5 s" in capsys.readouterr().out
    assert asked == [{"gain": 0.5, "offset": -2.0, "over_s": 1.5}]


def test_a_mark_is_one_text_however_many_words_it_has(going, capsys):
    sent = []

    def mark_run(run, text):
        sent.append(text)
        return {"sample": 600, "text": text}

    going.setattr("hilctl.cli.steering.mark_run", mark_run)
    assert steer("mark", ["tapped", "the stage"]) == 0
    assert "marked sample 600: tapped the stage" in capsys.readouterr().out
    assert steer("mark", ["tapped", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sample"] == 600
    assert sent == ["tapped the stage", "tapped"]
