"""What all commands share: JSON that any reader takes, and finishing what others left."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.cli.output import finish_orphans, print_json
from hilctl.run.orphans import Orphan


def test_json_is_one_object_without_nan(capsys):
    print_json({"gain": 0.5, "names": ["a"]})
    assert json.loads(capsys.readouterr().out) == {"gain": 0.5, "names": ["a"]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        print_json({"gain": float("nan")})


def test_orphans_are_told_on_standard_error(monkeypatch, capsys):
    """A program that reads standard output is not disturbed."""
    found = [Orphan("sine-7", Path("a.mcap"), safe=False, text="supervisor and loop died")]
    monkeypatch.setattr("hilctl.run.orphans.recover_orphans", lambda: found)
    finish_orphans()
    assert capsys.readouterr().err == ""  # nobody has died
    dead = SimpleNamespace(alive=False)
    monkeypatch.setattr("hilctl.run.run_folder.runs", lambda: [dead])
    finish_orphans()
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "sine-7 had died: supervisor and loop died" in shown.err
    assert "recovered into a.mcap" in shown.err
