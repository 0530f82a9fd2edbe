"""A report in a terminal."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from hilctl.analysis.figures import RunReport
from hilctl.analysis.report import summarize
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.cli.report_view import render

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
    console.print(render(report))
    return console.export_text()


def test_floor_stands_beside_the_hysteresis(lagging) -> None:
    """The figure that noise can fake is never shown without its floor."""
    recording = lagging()
    recording.samples.displacement_um[:] += np.random.default_rng(2).normal(0.0, 0.03, 5000)
    report = summarize(recording)
    line = next(t for t in terminal(report).splitlines() if "peak hysteresis" in t)
    assert f"{report.peak_hysteresis_percent:.4g} %" in line
    assert f"noise floor {report.noise_floor_percent:.4g} %" in line


def test_simulation_is_told(lagging) -> None:
    """A simulated device is called so, a real one is not."""
    simulated = lagging(run={"name": "x", "device": "my_rig", "simulated": "true"})
    assert "no hardware was driven" in terminal(summarize(simulated))
    assert "no hardware was driven" not in terminal(summarize(lagging()))


def test_names_are_not_markup(lagging) -> None:
    """Square brackets in names and labels are shown as they are."""
    parts = [segment(0, 2000, 1000.0, "[red]a[/red]"), segment(2000, 3000, 1000.0, "[b]")]
    run = {"name": "[bold]name", "device": "[dac]"}
    text = terminal(summarize(lagging(run=run, segments=parts)))
    for shown in ("[bold]name", "[dac]", "[red]a[/red]", "[b]"):
        assert shown in text


def test_uncompensated_run_shows_no_errors(make_recording) -> None:
    """Rows that can't have a value in such a run are left out."""
    recording = make_recording(wave(1000.0, 3), segments=[segment(0, 3000, 1000.0)])
    text = terminal(summarize(recording))
    assert "error" not in text
    assert "nothing compensated" in text


def test_segments_have_a_table_without_empty_columns(make_recording) -> None:
    """Several segments are listed; columns that no segment fills are left out."""
    parts = [segment(0, 3000, 1000.0, "first"), segment(3000, 3000, 1000.0, "second")]
    recording = make_recording(wave(1000.0, 6, LAG), command=wave(1000.0, 6), segments=parts)
    text = terminal(summarize(recording))
    for shown in ("first", "second", "peak hyst. %"):
        assert shown in text
    assert "err. %" not in text


def test_incomplete_run_is_told(lagging) -> None:
    """A run cut short can't be taken for a whole one."""
    assert "NOT complete" in terminal(summarize(replace(lagging(), end={})))


@pytest.mark.parametrize(("minutes", "shown"), [(20, range(20)), (21, range(1, 21))])
def test_of_many_minutes_the_worst_are_shown(lagging, minutes, shown) -> None:
    """In their order, with whole numbers of ticks."""
    late = {"p50": 80.0, "p90": 90.0, "p99": 95.0, "p99.9": 99.0}
    rows = [{"minute": k, "ticks": 60_000, **late, "max": 100.0 + k} for k in range(minutes)]
    text = terminal(replace(summarize(lagging()), lateness_by_minute=rows))
    table = text[text.index("lateness by minute, µs") :].splitlines()
    assert ("worst 20 of 21" in table[0]) == (minutes > 20)
    cells = [line.split("│") for line in table if line.startswith("│")]
    assert [int(row[1]) for row in cells] == list(shown)
    assert {row[2].strip() for row in cells} == {"60,000"}
