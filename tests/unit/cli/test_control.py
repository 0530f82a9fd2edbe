"""Commands on active runs: exit codes, JSON and printed lines."""

import json

import pytest

from hilctl.base.errors import InputError
from hilctl.cli.commands import load
from hilctl.cli.control import print_change, print_status, print_stopped


def call(name, words):
    return load(name)(words, standalone_mode=False) or 0


@pytest.fixture
def answering(monkeypatch):
    """Replace the run that commands find."""

    class Card:
        name, recording = "sine-7", "a.mcap"

    class Going:
        card = Card

    monkeypatch.setattr("hilctl.cli.control.find_run", lambda name: Going)
    return monkeypatch


def stopped(*, ended, name="sine-7"):
    return {"name": name, "recording": "a.mcap", "ended": ended, "error": ""}


def test_status_without_runs_is_an_empty_list(capsys):
    assert call("status", ["--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"runs": []}


def test_stop_timeout_has_exit_code_3(answering, capsys):
    answering.setattr("hilctl.cli.control.stop_runs", lambda runs, wait_s: [stopped(ended=False)])
    assert call("stop", ["--wait", "2"]) == 3
    assert "still active" in capsys.readouterr().out


def test_stop_all_reports_each_run(answering, capsys):
    """A run that stays active is a failure; no run is not."""
    chosen = []

    def stop_runs(runs, wait_s):
        chosen.append((runs, wait_s))
        return [stopped(ended=name == "a", name=name) for name in runs]

    answering.setattr("hilctl.cli.control.stop_runs", stop_runs)
    answering.setattr("hilctl.cli.control.active_runs", lambda: ["a", "b"])
    assert call("stop", ["--all", "--json"]) == 3
    assert [each["ended"] for each in json.loads(capsys.readouterr().out)["runs"]] == [True, False]
    answering.setattr("hilctl.cli.control.active_runs", list)
    assert call("stop", ["--all"]) == 0
    assert chosen == [(["a", "b"], 60.0), ([], 60.0)]
    with pytest.raises(InputError, match="--all or --run"):
        call("stop", ["--all", "--run", "a"])


def test_set_prints_the_new_values(answering, capsys):
    answer = {"gain": 0.5, "offset": -2.0, "over_s": 1.5, "inverse": None}
    asked = []

    def set_run(run, **wanted):
        asked.append(wanted)
        return answer

    answering.setattr("hilctl.cli.control.set_run", set_run)
    assert call("set", ["gain=0.5", "offset=-2", "--over", "1.5"]) == 0
    assert "gain 0.5" in capsys.readouterr().out
    assert asked == [{"gain": 0.5, "offset": -2.0, "over_s": 1.5}]


def test_mark_joins_its_words(answering, capsys):
    sent = []

    def mark_run(run, text):
        sent.append(text)
        return {"sample": 600, "text": text}

    answering.setattr("hilctl.cli.control.mark_run", mark_run)
    assert call("mark", ["tapped", "the stage"]) == 0
    assert "sample 600" in capsys.readouterr().out
    assert call("mark", ["tapped", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sample"] == 600
    assert sent == ["tapped the stage", "tapped"]


PATH = "/home/somebody/a/folder/with/a/long/name/recordings/2026-11-21_terfenol_sine_6a.mcap"


RUNNING = {
    "name": "terfenol_sine_6a-12345",
    "state": "running",
    "recording": PATH,
    "sample": 625_000,
    "total_samples": 1_500_000,
    "sample_rate_hz": 50_000.0,
    "recorded_samples": 624_500,
    "missing_samples": 500,
    "late_ticks": 1234,
    "gain": 0.5,
    "offset": -2.0,
    "inverse": "out",
    "recording_error": "",
}


@pytest.fixture
def shown(monkeypatch, capsys):
    """Return a function that returns the lines for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")

    def of(*found: dict) -> list[str]:
        print_status(list(found))
        return capsys.readouterr().out.splitlines()

    return of


def test_status_of_one_run(shown):
    """Each value is on a line with its name; no line is wrapped."""
    assert shown(RUNNING) == [
        "terfenol_sine_6a-12345  running",
        "  time       12.5 of 30.0 s",
        "  samples    624,500 recorded, 500 missing",
        "  late ticks 1,234",
        "  reference  gain 0.5, offset -2",
        "  inverse    out",
        f"  recording  {PATH}",
    ]


def test_status_of_several_runs(shown):
    lines = shown(RUNNING, {**RUNNING, "name": "other[1]"})
    assert [line for line in lines if not line.startswith(" ")] == [
        "terfenol_sine_6a-12345  running",
        "other[1]  running",
    ]


def test_status_prints_errors(shown):
    """Of the recording, and of a run that does not answer."""
    assert shown({**RUNNING, "recording_error": "full"})[-1] == "  error      full"
    silent = {key: RUNNING[key] for key in ("name", "recording")}
    assert shown({**silent, "state": "not answering", "error": "timed out"}) == [
        "terfenol_sine_6a-12345  not answering",
        f"  recording  {PATH}",
        "  error      timed out",
    ]


def test_status_without_runs(shown):
    assert shown() == ["no active run"]


@pytest.mark.parametrize(("inverse", "said"), [(None, ""), ("out", ", inverse out")])
def test_change_is_one_line(capsys, inverse, said):
    print_change("sine-7", {"gain": 0.5, "offset": -2.0, "inverse": inverse, "over_s": 1.5})
    assert capsys.readouterr().out == f"sine-7: gain 0.5, offset -2{said}, over 1.5 s\n"


def test_stop_prints_one_line_per_run(capsys):
    print_stopped(
        [
            {"name": "a", "recording": "a.mcap", "ended": True, "error": ""},
            {"name": "b", "recording": "b.mcap", "ended": False, "error": ""},
            {"name": "c", "recording": "c.mcap", "ended": False, "error": "no right"},
        ],
        2.0,
    )
    print_stopped([], 2.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "a stopped; recording: a.mcap"
    assert [line.partition(" ")[0] for line in lines] == ["a", "b", "c", "no"]
    assert lines[2].endswith("no right")
