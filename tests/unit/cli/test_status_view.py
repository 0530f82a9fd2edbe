"""What status, set and stop print of runs."""

import pytest

from hilctl.cli.status_view import print_change, print_status, print_stopped

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
    """Return a function that gives the lines that a terminal of 80 columns gets."""
    monkeypatch.setenv("COLUMNS", "80")

    def of(*found: dict) -> list[str]:
        print_status(list(found))
        return capsys.readouterr().out.splitlines()

    return of


def test_a_run_is_a_block_of_lines(shown):
    """Every figure stands on a line with its name; no line but the path's is cut or wrapped."""
    assert shown(RUNNING) == [
        "terfenol_sine_6a-12345  running",
        "  at         12.5 of 30.0 s",
        "  samples    624,500 recorded, 500 missing",
        "  late ticks 1,234",
        "  reference  gain 0.5, offset -2",
        "  inverse    out",
        f"  recording  {PATH}",
    ]


def test_runs_follow_one_another(shown):
    """Each has a block of its own."""
    lines = shown(RUNNING, {**RUNNING, "name": "other[1]"})
    assert [line for line in lines if not line.startswith(" ")] == [
        "terfenol_sine_6a-12345  running",
        "other[1]  running",
    ]


def test_trouble_is_told(shown):
    """A recording that can't be written, and a run that does not answer, say so."""
    assert shown({**RUNNING, "recording_error": "full"})[-1] == "  trouble    full"
    silent = {key: RUNNING[key] for key in ("name", "recording")}
    assert shown({**silent, "state": "not answering", "error": "timed out"}) == [
        "terfenol_sine_6a-12345  not answering",
        f"  recording  {PATH}",
        "  trouble    timed out",
    ]


def test_no_run_is_told(shown):
    """Silence could be taken for an error."""
    assert shown() == ["no run is going on"]


@pytest.mark.parametrize(("inverse", "said"), [(None, ""), ("out", ", inverse out")])
def test_a_change_is_one_line(capsys, inverse, said):
    print_change("sine-7", {"gain": 0.5, "offset": -2.0, "inverse": inverse, "over_s": 1.5})
    assert capsys.readouterr().out == f"sine-7: gain 0.5, offset -2{said}, over 1.5 s\n"


def test_each_stopped_run_has_a_line(capsys):
    print_stopped(
        [
            {"name": "a", "recording": "a.mcap", "ended": True, "error": ""},
            {"name": "b", "recording": "b.mcap", "ended": False, "error": ""},
            {"name": "c", "recording": "c.mcap", "ended": False, "error": "no right"},
        ],
        2.0,
    )
    print_stopped([], 2.0)
    assert capsys.readouterr().out.splitlines() == [
        "a has ended; recording: a.mcap",
        "b is still going after 2 s: it was requested to stop",
        "c is still going after 2 s: no right",
        "no run is going on",
    ]
