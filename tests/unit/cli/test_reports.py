"""Commands that evaluate recordings: report, figures, replay."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.console import Console

from hilctl.analysis import html
from hilctl.analysis import replay as replaying
from hilctl.analysis.replay import ReplayResult
from hilctl.analysis.report import summarize
from hilctl.analysis.run_metrics import RunReport
from hilctl.base.errors import InputError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.cli.commands import load
from hilctl.cli.console import print_rich
from hilctl.cli.recordings import export, recover
from hilctl.cli.reports import figures, print_replay, render_report, render_series, replay, report
from hilctl.studies.multi_run.collect import RunSeries
from tests.unit.studies.multi_run.conftest import grown

UNCOMPENSATED = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


@pytest.fixture
def recording(tmp_path):
    return Path(shutil.copy(UNCOMPENSATED, tmp_path / "run.mcap"))


def read_recording(name, words):
    return load(name)(words, standalone_mode=False) or 0


def printed(capsys):
    return json.loads(capsys.readouterr().out)


def test_report_replay_recover_and_export_agree_on_the_samples(recording, tmp_path, capsys):
    report([recording], as_json=True)
    samples = printed(capsys)["recorded_samples"]
    replay(recording, as_json=True)
    assert printed(capsys)["samples"] == samples
    recover(recording, as_json=True)
    assert printed(capsys)["samples"] == samples
    export(recording, tmp_path / "run.csv", as_json=True)
    assert printed(capsys) == {"output": str(tmp_path / "run.csv"), "rows": samples}
    assert len((tmp_path / "run.csv").read_text().splitlines()) == samples + 1


def test_different_replay_has_exit_code_1(recording, monkeypatch):
    found = replaying.replay

    def different(recording, model):
        return replace(found(recording, model), identical=False, first_difference=0)

    monkeypatch.setattr(replaying, "replay", different)
    with pytest.raises(typer.Exit) as ended:
        replay(recording, as_json=True)
    assert ended.value.exit_code == 1


def test_all_recordings_of_a_folder_are_exported(tmp_path, monkeypatch, capsys):
    """Exit code 1 if a file is not exported."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = Path(shutil.copytree(UNCOMPENSATED.parent, tmp_path / "recordings"))
    export(folder, tmp_path / "out", every=True)
    assert "3 recordings written, 0 already present" in capsys.readouterr().out
    (folder / "no.mcap").write_text("hello")
    with pytest.raises(typer.Exit) as ended:
        export(folder, tmp_path / "out", every=True, as_json=True)
    assert ended.value.exit_code == 1
    found = printed(capsys)
    assert (found["written"], found["there"], list(found["left_out"])) == (0, 3, ["no.mcap"])
    with pytest.raises(InputError, match="--all"):
        export(folder, tmp_path / "out", every=True, overwrite=True)


def test_options_and_arguments_in_any_order(recording, tmp_path, capsys):
    stretch = ["--from", "0.1", "--to=0.2"]
    assert read_recording("report", ["--json", str(recording), *stretch]) == 0
    samples = printed(capsys)["recorded_samples"]
    out = tmp_path / "run.csv"
    assert read_recording("export", [str(recording), *stretch, str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: {samples} samples\n"
    with pytest.raises(InputError, match="exists already"):
        read_recording("export", [str(recording), str(out)])
    assert read_recording("export", [str(recording), str(out), "--overwrite", "--json"]) == 0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["run.mcap", "--before", "run.mcap"], "--html"),
        (["run.mcap", "--model", "model.yaml"], "--model"),
        (["run.mcap", "run.mcap", "--from", "1"], "--from, --to"),
    ],
)
def test_incompatible_options_are_refused(words, text):
    with pytest.raises(InputError, match=text):
        read_recording("report", words)


GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


RUN = GOLDEN / "terfenol_uncompensated.mcap"


def test_several_runs_are_one_object_or_a_table(capsys):
    report([RUN, RUN], as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["headline"].startswith("2 runs, all completed.")
    assert [run["recording"] for run in found["runs"]] == [RUN.name] * 2
    report([RUN, RUN])
    shown = capsys.readouterr().out
    assert shown.startswith("2 runs, all completed.")
    assert "2: terfenol_uncompensated.mcap" in shown


def test_folder_is_one_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(html, "drawn", lambda sheet: None)
    monkeypatch.setattr(html, "svg", lambda figure: "<svg></svg>")
    page = tmp_path / "page.html"
    report([GOLDEN], html=page)
    assert "runs, all completed" in page.read_text(encoding="utf-8")
    assert "all completed" in capsys.readouterr().out
    with pytest.raises(InputError, match="exists already"):
        report([GOLDEN], html=page)


def test_options_of_one_recording_are_refused_for_several():
    with pytest.raises(InputError, match="--before"):
        report([RUN, RUN], from_s=1.0)
    with pytest.raises(InputError, match="--model"):
        report([RUN], model=Path("x.yaml"))
    with pytest.raises(InputError, match="--html"):
        report([RUN], before=RUN)


def test_figures_are_written_to_a_folder(tmp_path, capsys):
    folder = tmp_path / "runs"
    folder.mkdir()
    for name in ("terfenol_uncompensated", "terfenol_compensated"):
        shutil.copy(GOLDEN / f"{name}.mcap", folder)
    figures([folder], formats="svg", width="single", as_json=True)
    written = [Path(name) for name in json.loads(capsys.readouterr().out)["figures"]]
    assert written
    assert all(path.parent == folder / "figures" and path.is_file() for path in written)
    with pytest.raises(InputError, match="--format"):
        figures([folder], formats="gif")


def test_unreadable_runs_are_listed_without_control_characters(capsys):
    runs = (grown(3.0, 10.0), grown(3.0, 100.0, 2))
    missing = ("lost.mcap: \x1b[2J[bold]no such file",)
    print_rich(render_series(RunSeries("[red]two", runs, ("waveform.frequency_hz",), missing)))
    shown = capsys.readouterr().out
    assert shown.startswith("2 runs")
    assert "[red]two" in shown
    assert "not read: lost.mcap: \\x1b[2J[bold]no such file" in shown
    assert "\x1b[2J" not in shown
    assert [line.split(":")[0] for line in shown.splitlines()[-2:]] == ["1", "2"]


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
    assert "no hardware was driven" in terminal(summarize(simulated))
    assert "no hardware was driven" not in terminal(summarize(lagging()))


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


SAME = ReplayResult(
    samples=900, left_out_samples=0, identical=True, first_difference=None, differing_samples=0,
    largest_difference=0.0, rms_difference=0.0, command_unit="A", command_min=-1.5,
    command_max=2.25, limited_samples=7,
)  # fmt: skip


OTHER = replace(
    SAME, identical=False, first_difference=12, differing_samples=3, largest_difference=0.5
)


@pytest.fixture
def shown(monkeypatch, capsys):
    """Return a function that returns the output for a terminal of 120 columns."""
    monkeypatch.setenv("COLUMNS", "120")

    def of(result, **more):
        print_replay(result, **{"other": None, **more})
        return capsys.readouterr().out

    return of


def test_identical_replay_is_one_line(shown):
    assert shown(SAME) == "identical: 900 commands, bit for bit\n"


def test_different_commands_are_counted(shown):
    text = shown(OTHER)
    assert "different: 3 of 900 commands, the first at sample 12" in text
    assert "largest difference 0.5 A" in text


def test_replay_with_another_model_is_not_called_identical(shown, tmp_path):
    text = shown(SAME, other="m.yaml")
    assert "identical" not in text
    assert "with m.yaml the command ranges from -1.5 to 2.25 A, 7 samples limited" in text


def test_samples_after_a_gap_are_counted(shown):
    assert shown(replace(SAME, left_out_samples=50)).startswith("50 samples after a gap")
