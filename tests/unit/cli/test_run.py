"""Commands on one run: exit codes, JSON and printed results."""

import io
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.console import Console

from hilctl.analysis.report import summarize
from hilctl.analysis.run_metrics import RunReport
from hilctl.base.errors import InputError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.cli import run as module
from hilctl.cli.run import (
    check,
    print_run,
    render_report,
    report_of,
    run,
    run_mapping,
    run_progress,
    safe,
)
from hilctl.run.result import RunResult
from hilctl.run.safety.manual_safe import SafeResult

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


ENDED = RunResult(Path("a.mcap"), "stopped", "hilctl stop", "confirmed", 15, 0, 3, 2)


def test_run_mapping():
    assert run_mapping(ENDED, None) == {
        "recorded_samples": 0,
        "dropped": 3,
        "output": "a.mcap",
        "code": "stopped",
        "reason": "hilctl stop",
        "output_safe": True,
        "output_state": "confirmed",
        "guardian_active": False,
        "deadline_misses": "",
        "adapted": {},
    }


def test_address_of_the_page_is_printed_with_the_first_samples(capsys):
    with run_progress(quiet=True, addresses=["http://127.0.0.1:5/#x"]) as update:
        assert capsys.readouterr().err == ""
        update(None)
        update(None)
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
    assert "offset +1.25 µm, gain 1.0200" in capsys.readouterr().out


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
    with module._watched():
        assert started[0][1].poll() is None
    ((command, process),) = started
    assert command[-2:] == ["hilctl.cli.live", str(os.getpid())]
    assert process.returncode == -(signal.SIGKILL if ignores else signal.SIGTERM)


LAG = 0.05


def wave(period: float, cycles: int, lag: float = 0.0) -> F64:
    """Return whole cycles of a sine in um."""
    return 40.0 * np.sin(2.0 * np.pi * np.arange(period * cycles) / period - lag)


def segment(start: int, samples: int, period: float, label: str = "sine") -> Segment:
    """Return a segment without soft start or end."""
    return Segment(label, start, start + samples, start, start + samples, period)


@pytest.fixture
def lagging(make_recording):
    """Return a builder of compensated recordings whose displacement lags."""

    def make(**more):
        signals = {"reference_um": wave(1000.0, 5), "segments": [segment(0, 5000, 1000.0)]}
        return make_recording(wave(1000.0, 5, LAG), **{**signals, **more})

    return make


def terminal(report: RunReport) -> str:
    """Return what a terminal of 120 columns shows."""
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(render_report(report))
    return console.export_text()


def test_noise_floor_is_printed_with_the_hysteresis(lagging) -> None:
    recording = lagging()
    recording.samples.displacement_um[:] += np.random.default_rng(2).normal(0.0, 0.03, 5000)
    report = summarize(recording)
    line = next(t for t in terminal(report).splitlines() if "peak hysteresis" in t)
    assert f"{report.peak_hysteresis_percent:.4g} %" in line
    assert f"noise floor {report.noise_floor_percent:.4g} %" in line


def test_simulated_device_is_marked(lagging) -> None:
    simulated = lagging(run={"name": "x", "device": "my_rig", "simulated": "true"})
    assert "no hardware" in terminal(summarize(simulated))
    assert "no hardware" not in terminal(summarize(lagging()))


def test_names_are_not_markup(lagging) -> None:
    parts = [segment(0, 2000, 1000.0, "[red]a[/red]"), segment(2000, 3000, 1000.0, "[b]")]
    run = {"name": "[bold]name", "device": "[dac]"}
    text = terminal(summarize(lagging(run=run, segments=parts)))
    for shown in ("[bold]name", "[dac]", "[red]a[/red]", "[b]"):
        assert shown in text


def test_uncompensated_run_shows_no_errors(make_recording) -> None:
    """Rows without a value are omitted."""
    recording = make_recording(wave(1000.0, 3), segments=[segment(0, 3000, 1000.0)])
    text = terminal(summarize(recording))
    assert "error" not in text
    assert "nothing compensated" in text


def test_segments_have_a_table_without_empty_columns(make_recording) -> None:
    """Columns without a value are omitted."""
    parts = [segment(0, 3000, 1000.0, "first"), segment(3000, 3000, 1000.0, "second")]
    recording = make_recording(wave(1000.0, 6, LAG), command=wave(1000.0, 6), segments=parts)
    text = terminal(summarize(recording))
    for shown in ("first", "second", "peak hyst. %"):
        assert shown in text
    assert "err. %" not in text


def test_incomplete_run_is_marked(lagging) -> None:
    assert "NOT complete" in terminal(summarize(replace(lagging(), end={})))


@pytest.mark.parametrize(("minutes", "shown"), [(20, range(20)), (21, range(1, 21))])
def test_worst_minutes_are_shown(lagging, minutes, shown) -> None:
    """In chronological order."""
    late = {"p50": 80.0, "p90": 90.0, "p99": 95.0, "p99.9": 99.0}
    rows = [{"minute": k, "ticks": 60_000, **late, "max": 100.0 + k} for k in range(minutes)]
    text = terminal(replace(summarize(lagging()), lateness_by_minute=rows))
    table = text[text.index("lateness per minute, µs") :].splitlines()
    assert ("worst 20 of 21" in table[0]) == (minutes > 20)
    cells = [line.split("│") for line in table if line.startswith("│")]
    assert [int(row[1]) for row in cells] == list(shown)
    assert {row[2].strip() for row in cells} == {"60,000"}
