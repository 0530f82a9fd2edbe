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
from rich.console import Console

from hilctl.analysis.report import summarize
from hilctl.base.segments import Segment
from hilctl.cli import run as module
from hilctl.cli.output import Verbosity
from hilctl.cli.reports import render_report
from hilctl.cli.run import print_forecast, print_run, run_progress
from hilctl.run.result import RunResult
from hilctl.run.safety.manual_safe import SafeResult
from hilctl.run.start import checked_run

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
ENDED = RunResult(Path("a.mcap"), "stopped", "hilctl stop", "confirmed", 15, 0, 3, 2)


@pytest.fixture
def started(monkeypatch):
    """Replace runs; return the arguments of their start, and the fields of their result."""
    asked, ends = [], {"code": "completed", "stop_signal": 0}

    def start_run(experiment, settings, output, overwrite, on_progress, *, take_over):
        asked.append((experiment, settings, output, overwrite, take_over))
        return replace(ENDED, **ends)

    monkeypatch.setattr("hilctl.api.runs.start_run", start_run)
    monkeypatch.setattr(module, "reports_of", lambda result, *, every: [])
    return asked, ends


@pytest.mark.parametrize(
    ("code", "stop_signal", "exit_code"), [("fault", 0, 3), ("stopped", signal.SIGTERM, 143)]
)
def test_exit_code_of_an_incomplete_run(started, hilctl, code, stop_signal, exit_code):
    started[1].update(code=code, stop_signal=stop_signal)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert hilctl("run", DEMO)[0] == exit_code
    finally:
        signal.signal(signal.SIGTERM, before)


def test_interrupted_report_keeps_the_result(started, hilctl, monkeypatch):
    def interrupted(result, *, every):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "reports_of", interrupted)
    before = signal.getsignal(signal.SIGINT)
    try:
        code, out, _ = hilctl("run", DEMO, "--json")
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert (code, json.loads(out)["code"]) == (130, "completed")


def test_options_reach_the_run(started, json_of):
    json_of("run", DEMO, "--require-rt", "--take-over", "--set", "block=25")
    assert started[0] == [(DEMO, ["block=25", "realtime.require=true"], None, False, True)]


def test_check_lists_the_triggers(json_of, hilctl):
    over = ["waveform.duration_s=1.0", "block=1", "sample_rate_hz=5000"]
    words = ["check", DEMO, *(w for text in over for w in ("--set", text))]
    assert json_of(*words)[1]["trigger"] is None
    words += ["--set", "trigger={output: run, start: low, timeout_s: 7}"]
    assert json_of(*words)[1]["trigger"] == {
        "output": "run", "start": "low", "timeout_s": 7.0, "marks": 1,
        "digital_output": "DO", "digital_output_s": 0.0, "digital_input": "DI",
    }  # fmt: skip
    row = hilctl(*words)[1]
    assert all(each in row for each in ("DO", "(1)", "DI", "low", "7 s"))


@pytest.mark.parametrize("as_json", [True, False])
def test_unconfirmed_safe_value_has_exit_code_3(monkeypatch, hilctl, as_json):
    put = {"": SafeResult("a device", 0.0, "A", "unknown", "no answer")}
    monkeypatch.setattr(module, "put_safe", lambda path, settings: put)
    code, out, err = hilctl("safe", DEMO, *["--json"] * as_json)
    assert code == 3
    assert "no answer" in (out if as_json else err)
    assert not as_json or json.loads(out)["output_safe"] is False


def test_safe_values_of_axes_are_reported_each(monkeypatch, hilctl):
    put = {
        "x": SafeResult("one", 0.0, "A", "confirmed", ""),
        "y": SafeResult("other", 0.0, "A", "unknown", "no answer", guardian_active=True),
    }
    monkeypatch.setattr(module, "put_safe", lambda path, settings: put)
    code, out, err = hilctl("safe", DEMO)
    assert (code, out[:8], err[:9]) == (3, "x: one: ", "y: other:")
    found = json.loads(hilctl("safe", DEMO, "--json")[1])
    assert (found["output_safe"], found["guardian_active"]) == (False, True)
    assert {name: each["output_state"] for name, each in found["axes"].items()} == {
        "x": "confirmed",
        "y": "unknown",
    }


@pytest.mark.parametrize("words", [["--detach", "--live"], ["--watch", "--json"]])
def test_incompatible_options_are_refused(hilctl, words):
    """The log of a background run must not contain the token of the page."""
    code, _, err = hilctl("run", DEMO, *words)
    assert (code, words[1] in err) == (2, True)


def test_address_of_the_page_is_printed_with_the_first_samples(capsys):
    with run_progress(quiet=True, addresses=["http://127.0.0.1:5/#x"]) as update:
        assert capsys.readouterr().err == ""
        update(None)
        update(None)
        assert capsys.readouterr().err == "live page: http://127.0.0.1:5/#x\n"


@pytest.mark.parametrize("safe", [True, False])
def test_unsafe_output_is_printed(capsys, safe):
    state = "confirmed" if safe else "unknown"
    print_run(replace(ENDED, code="fault", reason="lost", output_state=state), [])
    shown = capsys.readouterr().out
    assert "fault: lost" in shown
    assert "no samples" in shown
    assert ("Not safe" in shown) is not safe


def test_quiet_prints_a_fault(monkeypatch, capsys):
    monkeypatch.setattr(Verbosity, "quiet", True)
    print_run(ENDED, [])
    assert capsys.readouterr().err == ""
    print_run(replace(ENDED, code="fault", reason="lost"), [])
    assert "lost" in capsys.readouterr().err


def test_adaptation_is_printed_without_a_report(capsys):
    adapted = {"offset_um": 1.25, "gain": 1.02, "weight_1": -0.005}
    print_run(replace(ENDED, samples=9, adapted=adapted), [])
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


def wave(period, cycles, lag=0.0):
    """Return whole cycles of a sine in um."""
    return 40.0 * np.sin(2.0 * np.pi * np.arange(period * cycles) / period - lag)


def segment(start, samples, period, label="sine"):
    """Return a segment without soft start or end."""
    return Segment(label, start, start + samples, start, start + samples, period)


@pytest.fixture
def lagging(make_recording):
    """Return a builder of compensated recordings whose displacement lags."""

    def make(**more):
        signals = {"reference_um": wave(1000.0, 5), "segments": [segment(0, 5000, 1000.0)]}
        return make_recording(wave(1000.0, 5, LAG), **{**signals, **more})

    return make


def terminal(report):
    """Return what a terminal of 120 columns shows."""
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(render_report(report))
    return console.export_text()


def test_noise_floor_is_printed_with_the_hysteresis(lagging):
    recording = lagging()
    recording.samples.displacement_um[:] += np.random.default_rng(2).normal(0.0, 0.03, 5000)
    report = summarize(recording)
    line = next(t for t in terminal(report).splitlines() if "peak hysteresis" in t)
    assert f"{report.peak_hysteresis_percent:.4g} %" in line
    assert f"noise floor {report.noise_floor_percent:.4g} %" in line


def test_simulated_and_incomplete_runs_are_marked(lagging):
    simulated = lagging(run={"name": "x", "device": "my_rig", "simulated": "true"})
    assert "no hardware" in terminal(summarize(simulated))
    assert "no hardware" not in terminal(summarize(lagging()))
    assert "NOT complete" in terminal(summarize(replace(lagging(), end={})))


@pytest.mark.parametrize(("minutes", "shown"), [(20, range(20)), (21, range(1, 21))])
def test_worst_minutes_are_shown(lagging, minutes, shown):
    late = {"p50": 80.0, "p90": 90.0, "p99": 95.0, "p99.9": 99.0}
    rows = [{"minute": k, "ticks": 60_000, **late, "max": 100.0 + k} for k in range(minutes)]
    text = terminal(replace(summarize(lagging()), lateness_by_minute=rows))
    table = text[text.index("lateness per minute, µs") :].splitlines()
    assert ("worst 20 of 21" in table[0]) == (minutes > 20)
    cells = [line.split("│") for line in table if line.startswith("│")]
    assert [int(row[1]) for row in cells] == list(shown)
    assert {row[2].strip() for row in cells} == {"60,000"}


def test_segments_have_a_table_without_empty_columns(make_recording):
    parts = [segment(0, 3000, 1000.0, "first"), segment(3000, 3000, 1000.0, "second")]
    recording = make_recording(wave(1000.0, 6, LAG), command=wave(1000.0, 6), segments=parts)
    text = terminal(summarize(recording))
    for shown in ("first", "second", "peak hyst. %"):
        assert shown in text
    assert "err. %" not in text


def test_a_forecast_has_common_rows_once(capsys):
    stage = Path(__file__).parents[3] / "configs" / "stage_xy.yaml"
    print_forecast(checked_run(stage, ["axes.x.waveform.amplitude=20"]))
    rows = [line.split("  ")[0] for line in capsys.readouterr().out.splitlines()]
    counts = [rows.count(row) for row in ("duration", "recording", "command", "Axis x", "Axis y")]
    assert counts == [1, 1, 2, 1, 1]
    assert rows.index("duration") < rows.index("Axis x")
