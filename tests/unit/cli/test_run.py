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
    """Return a function that sets the result of a run and returns the arguments of its start."""
    started = []

    def so(code, stop_signal=0):
        def start_run(experiment, settings, output, overwrite, on_progress):
            started.append((experiment, settings, output, overwrite))
            return RunResult(Path("no.mcap"), code, "because", "confirmed", stop_signal, 0, 0, 0)

        monkeypatch.setattr("hilctl.api.runs.start_run", start_run)
        monkeypatch.setattr("hilctl.cli.run.report_of", lambda result, *, every: None)
        return started

    return so


@pytest.mark.parametrize(
    ("code", "stop_signal", "exit_code"), [("fault", 0, 3), ("stopped", signal.SIGTERM, 143)]
)
def test_exit_code_of_an_incomplete_run(ended, code, stop_signal, exit_code):
    before = signal.getsignal(signal.SIGTERM)
    ended(code, stop_signal)
    try:
        with pytest.raises(typer.Exit) as left:
            run(DEMO, as_json=True)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert left.value.exit_code == exit_code


def test_require_rt_is_the_last_setting(ended, capsys):
    started = ended("completed")
    run(DEMO, settings=["block=25"], require_rt=True, as_json=True)
    assert started == [(DEMO, ["block=25", "realtime.require=true"], None, False)]
    assert json.loads(capsys.readouterr().out)["code"] == "completed"


def test_check_prints_the_forecast(capsys):
    check(DEMO, ["waveform.duration_s=1.0"], as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["experiment"] == str(DEMO)
    assert printed["samples"] == 50_000


@pytest.mark.parametrize("as_json", [True, False])
def test_unconfirmed_safe_value_has_exit_code_3(monkeypatch, capsys, as_json):
    put = SafeResult("a device", 0.0, "A", "unknown", "no answer")
    monkeypatch.setattr("hilctl.cli.run.put_safe", lambda path, settings: put)
    with pytest.raises(typer.Exit) as left:
        safe(DEMO, as_json=as_json)
    assert left.value.exit_code == 3
    out, err = capsys.readouterr()
    assert "no answer" in (out if as_json else err)
    assert not as_json or json.loads(out)["output_safe"] is False


def test_confirmed_safe_value_is_printed(monkeypatch, capsys):
    put = SafeResult("a device", 0.25, "A", "confirmed", "")
    monkeypatch.setattr("hilctl.cli.run.put_safe", lambda path, settings: put)
    safe(DEMO)
    assert "0.25 A" in capsys.readouterr().out


def test_detach_excludes_live():
    """The log of a background run must not contain the token of the page."""
    with pytest.raises(InputError, match="hilctl live"):
        run(DEMO, detach=True, live=True)


ENDED = RunResult(Path("a.mcap"), "stopped", "stopped by hilctl stop", "confirmed", 15, 0, 3, 2)


def test_run_mapping():
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


def test_address_of_the_page_is_printed_with_the_first_samples(capsys):
    with LiveView(quiet=True, addresses=["http://127.0.0.1:5/#x"]) as view:
        assert capsys.readouterr().err == ""
        view.update(None)
        view.update(None)
        assert capsys.readouterr().err == "live page: http://127.0.0.1:5/#x\n"


def test_run_without_samples_has_no_report():
    assert report_of(ENDED, every=False) is None


@pytest.mark.parametrize("safe", [True, False])
def test_unsafe_output_is_printed(capsys, safe):
    result = RunResult(
        Path("a.mcap"), "fault", "lost", "confirmed" if safe else "unknown", 0, 0, 0, 0
    )
    print_run(result, None)
    shown = capsys.readouterr().out
    assert "fault: lost" in shown
    assert "no samples" in shown
    assert ("Not safe" in shown) is not safe


def test_adaptation_is_printed_without_a_report(capsys):
    adapted = {"offset_um": 1.25, "gain": 1.02, "weight_1": -0.005}
    print_run(
        RunResult(Path("a.mcap"), "completed", "", "confirmed", 0, 9, 0, 0, adapted=adapted), None
    )
    assert "adapted: offset +1.25 µm, gain 1.0200, weights -0.0050" in capsys.readouterr().out


@pytest.mark.parametrize("ignores", ["", "signal.signal(15, signal.SIG_IGN);"])
def test_subprocess_of_the_view_ends_with_the_run(monkeypatch, ignores):
    monkeypatch.setattr(module, "_VIEW_END_S", 0.2)
    started = []

    class Started(subprocess.Popen):
        def __init__(self, command):
            code = f"import signal, time; {ignores} print(flush=True); time.sleep(60)"
            super().__init__([sys.executable, "-c", code], stdout=subprocess.PIPE)
            self.stdout.readline()
            started.append((command, self))

    monkeypatch.setattr(subprocess, "Popen", Started)
    with module._watched(requested=True):
        assert started[0][1].poll() is None
    ((command, process),) = started
    assert command[-2:] == ["hilctl.cli.live", str(os.getpid())]
    assert process.returncode == -(signal.SIGKILL if ignores else signal.SIGTERM)
