"""How a run ended, for people and for programs."""

from pathlib import Path

import pytest

from hilctl.cli.run_view import LiveView, print_run, report_of, run_mapping
from hilctl.run.result import RunResult

ENDED = RunResult(Path("a.mcap"), "stopped", "stopped by hilctl stop", "confirmed", 15, 0, 3, 2)


def test_a_program_reads_how_the_run_ended():
    assert run_mapping(ENDED, None) == {
        "recorded_samples": 0,
        "dropped": 3,
        "output": "a.mcap",
        "code": "stopped",
        "reason": "stopped by hilctl stop",
        "output_safe": True,
        "output_state": "confirmed",
        "guardian_active": False,
        "deadline_misses": "",
        "adapted": {},
    }


def test_the_address_of_a_page_is_printed_once_there_is_something_to_look_at(capsys):
    with LiveView(quiet=True, addresses=["http://127.0.0.1:5/#x"]) as view:
        assert capsys.readouterr().err == ""
        view.update(None)
        view.update(None)
        assert capsys.readouterr().err == "live page: http://127.0.0.1:5/#x\n"


def test_no_report_is_made_of_no_sample():
    """The file is not even opened."""
    assert report_of(ENDED, whole=False) is None


@pytest.mark.parametrize("safe", [True, False])
def test_an_output_that_may_not_be_safe_is_said(capsys, safe):
    result = RunResult(
        Path("a.mcap"), "fault", "lost", "confirmed" if safe else "unknown", 0, 0, 0, 0
    )
    print_run(result, None)
    shown = capsys.readouterr().out
    assert "fault: lost" in shown
    assert "no sample was recorded" in shown
    assert ("Not safe" in shown) is not safe


def test_what_was_adapted_is_said_of_a_run_without_a_report(capsys):
    adapted = {"offset_um": 1.25, "gain": 1.02, "weight_1": -0.005}
    print_run(
        RunResult(Path("a.mcap"), "completed", "", "confirmed", 0, 9, 0, 0, adapted=adapted), None
    )
    assert "adapted: offset +1.25 µm, gain 1.0200, weights -0.0050" in capsys.readouterr().out
