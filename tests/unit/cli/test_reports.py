"""Commands that evaluate recordings: report, figures, replay."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from hilctl.analysis import html
from hilctl.analysis.replay import ReplayResult
from hilctl.analysis.replay import replay as recompute
from hilctl.base.errors import InputError
from hilctl.cli.commands import load
from hilctl.cli.console import print_rich
from hilctl.cli.recordings import export, recover
from hilctl.cli.reports import figures, print_replay, render_series, replay, report
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
    found = recompute

    def different(recording, model):
        return replace(found(recording, model), identical=False, first_difference=0)

    monkeypatch.setattr("hilctl.api.reports.recompute", different)
    with pytest.raises(typer.Exit) as ended:
        replay(recording, as_json=True)
    assert ended.value.exit_code == 1


def test_all_recordings_of_a_folder_are_exported(tmp_path, monkeypatch, capsys):
    """Exit code 1 if a file is not exported."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = Path(shutil.copytree(UNCOMPENSATED.parent, tmp_path / "recordings"))
    export(folder, tmp_path / "out", every=True)
    assert "3 recordings written" in capsys.readouterr().out
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
    with pytest.raises(InputError, match="exists"):
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
    with pytest.raises(InputError, match="exists"):
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
    assert "lost.mcap: \\x1b[2J[bold]no such file" in shown
    assert "\x1b[2J" not in shown
    assert [line.split(":")[0] for line in shown.splitlines()[-2:]] == ["1", "2"]


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
    assert "3 of 900 commands" in text
    assert "largest difference 0.5 A" in text


def test_replay_with_another_model_is_not_called_identical(shown, tmp_path):
    text = shown(SAME, other="m.yaml")
    assert "identical" not in text
    assert all(value in text for value in ("m.yaml", "-1.5 to 2.25 A", "7 samples"))


def test_samples_after_a_gap_are_counted(shown):
    assert shown(replace(SAME, left_out_samples=50)).startswith("50 samples after a gap")
