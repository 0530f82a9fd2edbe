"""What all commands share: JSON that any reader takes, and finishing what others left."""

import json

from hilctl.cli.output import finish_orphans, print_json


def test_json_is_one_object_without_nan(capsys):
    print_json({"gain": 0.5, "names": ["a"]})
    assert json.loads(capsys.readouterr().out) == {"gain": 0.5, "names": ["a"]}
    print_json({"gain": float("nan"), "largest": [float("inf")]})
    assert json.loads(capsys.readouterr().out) == {"gain": None, "largest": [None]}


def test_what_had_died_is_finished_first(monkeypatch):
    called = []
    monkeypatch.setattr("hilctl.run.dead_runs.finish_dead_runs", lambda: called.append(True))
    finish_orphans()
    assert called
