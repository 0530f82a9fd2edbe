"""Commands on active runs: exit codes, JSON and printed lines."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.cli import control
from hilctl.cli.control import print_change, print_status, print_stopped


@pytest.fixture
def answering(monkeypatch):
    """Replace the run that commands find; return a function that replaces a request to it."""
    card = SimpleNamespace(name="sine-7", recording="a.mcap")
    monkeypatch.setattr(control, "find_run", lambda name: SimpleNamespace(card=card))
    return lambda name, request: monkeypatch.setattr(control, name, request)


def stopped(name, *, ended, error=""):
    return {"name": name, "recording": f"{name}.mcap", "ended": ended, "error": error}


def test_stop_timeout_has_exit_code_3(answering, hilctl):
    answering("stop_runs", lambda runs, wait_s: [stopped("a", ended=False)])
    code, shown, _ = hilctl("stop", "--wait", "2")
    assert code == 3
    assert "still active" in shown


PATH = "/home/somebody/a/folder/with/a/long/name/recordings/2026-11-21_terfenol_sine_6a.mcap"
RUNNING = {
    "name": "terfenol_sine_6a-12345", "state": "running", "recording": PATH,
    "sample": 625_000, "total_samples": 1_500_000, "sample_rate_hz": 50_000.0,
    "recorded_samples": 624_500, "missing_samples": 500, "late_ticks": 1234,
    "gain": 0.5, "offset": -2.0, "inverse": "out", "recording_error": "",
}  # fmt: skip


@pytest.fixture
def shown(monkeypatch, capsys):
    """Return a function that returns the lines for a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")

    def of(*found):
        print_status(list(found))
        return capsys.readouterr().out.splitlines()

    return of


def test_status_of_one_run(shown):
    assert shown(RUNNING) == [
        "terfenol_sine_6a-12345  running",
        "  time       12.5 of 30.0 s",
        "  samples    624,500 recorded, 500 missing",
        "  late ticks 1,234",
        "  reference  gain 0.5, offset -2",
        "  inverse    out",
        f"  recording  {PATH}",
    ]


def test_status_of_several_runs_has_their_errors(shown):
    silent = {"name": "other[1]", "state": "not answering", "recording": PATH, "error": "timed out"}
    lines = shown({**RUNNING, "recording_error": "full"}, silent)
    assert lines[0] == "terfenol_sine_6a-12345  running"
    assert lines[7:] == [
        "  error      full",
        "other[1]  not answering",
        f"  recording  {PATH}",
        "  error      timed out",
    ]


def test_axes_have_lines_of_their_own(shown, capsys):
    values = {"gain": 0.5, "offset": 0.0, "inverse": "in"}
    references = {"x": values, "y": {**values, "inverse": None}}
    answer = {"references": references, "over_s": 1.0}
    print_change("stage-7", answer)
    assert capsys.readouterr().out.splitlines() == [
        "stage-7 x: gain 0.5, offset 0, inverse in, over 1 s",
        "stage-7 y: gain 0.5, offset 0, over 1 s",
    ]
    lines = [line.split()[:2] for line in shown({**RUNNING, "references": references})]
    assert [line for line in lines if line[0] in {"reference", "inverse"}] == [
        ["reference", "x"],
        ["inverse", "x"],
        ["reference", "y"],
    ]


@pytest.mark.parametrize(("inverse", "said"), [(None, ""), ("out", ", inverse out")])
def test_change_is_one_line(capsys, inverse, said):
    print_change("sine-7", {"gain": 0.5, "offset": -2.0, "inverse": inverse, "over_s": 1.5})
    assert capsys.readouterr().out == f"sine-7: gain 0.5, offset -2{said}, over 1.5 s\n"


def test_stop_prints_one_line_per_run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.mcap").touch()
    runs = [stopped("a", ended=True), stopped("b", ended=False)]
    print_stopped([*runs, stopped("c", ended=False, error="no right")], 2.0)
    print_stopped([stopped("d", ended=True)], 2.0)
    print_stopped([], 2.0)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "a stopped; recording: a.mcap"
    assert [line.partition(" ")[0] for line in lines] == ["a", "b", "c", "d", "no"]
    assert lines[3] == "d stopped; no recording"
    assert lines[2].endswith("no right")


def test_status_and_stop_without_runs(hilctl, json_of):
    assert json_of("status") == (0, {"runs": []})
    assert hilctl("status")[:2] == (0, "no active run\n")
    assert hilctl("stop", "--all")[0] == 0
    assert hilctl("stop", "--all", "--run", "a")[0] == 2
