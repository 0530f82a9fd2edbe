"""Commands on one run: exit codes, JSON and printed results."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli import run as module
from hilctl.cli.run import LiveView, check, print_run, report_of, run, run_mapping, safe
from hilctl.run.by_hand import SafeResult
from hilctl.run.result import RunResult

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture
def ended(monkeypatch):
    """Let a run end at once, as told; collect what it was started with."""
    started = []

    def so(code, stop_signal=0):
        def start_run(experiment, settings, output, overwrite, on_progress):
            started.append((experiment, settings, output, overwrite))
            return RunResult(Path("no.mcap"), code, "because", "confirmed", stop_signal, 0, 0, 0)

        monkeypatch.setattr("hilctl.run.start.start_run", start_run)
        monkeypatch.setattr("hilctl.cli.run.report_of", lambda result, *, every: None)
        return started

    return so


@pytest.mark.parametrize(
    ("code", "stop_signal", "exit_code"), [("fault", 0, 3), ("stopped", signal.SIGTERM, 143)]
)
def test_a_run_that_did_not_complete_says_so_by_its_exit_code(ended, code, stop_signal, exit_code):
    before = signal.getsignal(signal.SIGTERM)
    ended(code, stop_signal)
    try:
        with pytest.raises(typer.Exit) as left:
            run(DEMO, as_json=True)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert left.value.exit_code == exit_code


def test_require_rt_is_one_more_setting(ended, capsys):
    """Behind those that were given, which it goes before."""
    started = ended("completed")
    run(DEMO, settings=["block=25"], require_rt=True, as_json=True)
    assert started == [(DEMO, ["block=25", "realtime.require=true"], None, False)]
    assert json.loads(capsys.readouterr().out)["code"] == "completed"


def test_check_moves_nothing_and_says_what_would(capsys):
    check(DEMO, ["waveform.duration_s=1.0"], as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["experiment"] == str(DEMO)
    assert printed["samples"] == 50_000


@pytest.mark.parametrize("as_json", [True, False])
def test_an_output_that_is_not_known_to_be_safe_is_an_error(monkeypatch, capsys, as_json):
    """Exit code 3, as after a run."""
    put = SafeResult("a device", 0.0, "A", "unknown", "no answer")
    monkeypatch.setattr("hilctl.run.by_hand.put_safe", lambda path, settings: put)
    with pytest.raises(typer.Exit) as left:
        safe(DEMO, as_json=as_json)
    assert left.value.exit_code == 3
    out, err = capsys.readouterr()
    assert "no answer" in (out if as_json else err)
    assert not as_json or json.loads(out)["output_safe"] is False


def test_a_confirmed_safe_value_is_said(monkeypatch, capsys):
    put = SafeResult("a device", 0.25, "A", "confirmed", "")
    monkeypatch.setattr("hilctl.run.by_hand.put_safe", lambda path, settings: put)
    safe(DEMO)
    assert "0.25 A" in capsys.readouterr().out


def test_an_address_with_its_token_goes_into_no_log():
    """That of a run in the background may be read by others."""
    with pytest.raises(InputError, match="hilctl live"):
        run(DEMO, detach=True, live=True)


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
    assert report_of(ENDED, every=False) is None


@pytest.mark.parametrize("safe", [True, False])
def test_an_output_that_may_not_be_safe_is_said(capsys, safe):
    result = RunResult(
        Path("a.mcap"), "fault", "lost", "confirmed" if safe else "unknown", 0, 0, 0, 0
    )
    print_run(result, None)
    shown = capsys.readouterr().out
    assert "fault: lost" in shown
    assert "no samples" in shown
    assert ("Not safe" in shown) is not safe


def test_what_was_adapted_is_said_of_a_run_without_a_report(capsys):
    adapted = {"offset_um": 1.25, "gain": 1.02, "weight_1": -0.005}
    print_run(
        RunResult(Path("a.mcap"), "completed", "", "confirmed", 0, 9, 0, 0, adapted=adapted), None
    )
    assert "adapted: offset +1.25 µm, gain 1.0200, weights -0.0050" in capsys.readouterr().out


@pytest.mark.parametrize("ignores", ["", "signal.signal(15, signal.SIG_IGN);"])
def test_the_view_s_subprocess_ends_with_the_run(monkeypatch, ignores):
    monkeypatch.setattr(module, "_VIEW_END_S", 0.2)
    started = []

    class Started(subprocess.Popen):
        def __init__(self, command):
            code = f"import signal, time; {ignores} print(flush=True); time.sleep(60)"
            super().__init__([sys.executable, "-c", code], stdout=subprocess.PIPE)
            self.stdout.readline()
            started.append((command, self))

    monkeypatch.setattr(subprocess, "Popen", Started)
    with module._watched(wanted=True):
        assert started[0][1].poll() is None
    ((command, process),) = started
    assert command[-2:] == ["hilctl.cli.watch", str(os.getpid())]
    assert process.returncode == -(signal.SIGKILL if ignores else signal.SIGTERM)
