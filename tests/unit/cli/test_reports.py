"""Commands that evaluate recordings: report, figures, replay."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl import api
from hilctl.analysis.replay import ReplayResult
from hilctl.analysis.replay import replay as recompute
from hilctl.base.errors import InputError
from hilctl.cli.console import print_rich
from hilctl.cli.reports import print_replay, render_series
from hilctl.lab.pages import html
from hilctl.lab.studies.multi_run.collect import RunSeries
from tests.axes import run_of_axes
from tests.unit.lab.studies.multi_run.conftest import grown

CONFIGS = Path(__file__).parents[3] / "configs"
GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
RUN = GOLDEN / "terfenol_uncompensated.mcap"


@pytest.fixture
def recording(tmp_path):
    return Path(shutil.copy(RUN, tmp_path / "run.mcap"))


def test_report_replay_recover_and_export_agree_on_the_samples(recording, tmp_path, json_of):
    samples = json_of("report", recording)[1]["recorded_samples"]
    assert json_of("replay", recording)[1]["samples"] == samples
    assert json_of("recover", recording)[1]["samples"] == samples
    table = tmp_path / "run.csv"
    assert json_of("export", recording, table)[1] == {"output": str(table), "rows": samples}
    assert len(table.read_text().splitlines()) == samples + 1


def test_different_replay_has_exit_code_1(recording, monkeypatch, hilctl):
    def different(path, model):
        return replace(recompute(path, model), identical=False, first_difference=0)

    monkeypatch.setattr("hilctl.analysis.replay.replay", different)
    assert hilctl("replay", recording)[0] == 1


def test_all_recordings_of_a_folder_are_exported(tmp_path, hilctl, json_of):
    """Exit code 1 if a file is not exported."""
    folder = Path(shutil.copytree(GOLDEN, tmp_path / "recordings"))
    words = ("export", folder, tmp_path / "out", "--all")
    assert "3 recordings written" in hilctl(*words)[1]
    (folder / "no.mcap").write_text("hello")
    code, found = json_of(*words)
    assert code == 1
    assert (found["written"], found["there"], list(found["left_out"])) == (0, 3, ["no.mcap"])
    assert hilctl(*words, "--overwrite")[0] == 2


def test_options_and_arguments_in_any_order(recording, tmp_path, hilctl, json_of):
    stretch = ["--from", "0.1", "--to=0.2"]
    samples = json_of("report", recording, *stretch)[1]["recorded_samples"]
    out = tmp_path / "run.csv"
    code, shown, _ = hilctl("export", recording, *stretch, out)
    assert (code, shown) == (0, f"{out}: {samples} samples\n")
    assert hilctl("export", recording, out)[0] == 2
    assert json_of("export", recording, out, "--overwrite")[0] == 0


@pytest.mark.parametrize(("words", "option"), [
    ("report {} --before {}", "--html"),
    ("report {} --model model.yaml", "--model"),
    ("report {} {} --from 1", "--from"),
    ("report {} {} --to 1", "--to"),
    ("report {} {} --before {}", "--before"),
    ("figures {} --format gif", "--format"),
])  # fmt: skip
def test_wrong_options_are_refused(hilctl, words, option):
    code, _, err = hilctl(*(str(RUN) if word == "{}" else word for word in words.split()))
    assert (code, option in err) == (2, True)


def test_several_runs_are_one_object_or_a_table(hilctl, json_of):
    _, found = json_of("report", RUN, RUN)
    assert found["headline"].startswith("2 of 2 runs")
    assert [run["recording"] for run in found["runs"]] == [RUN.name] * 2
    _, shown, _ = hilctl("report", RUN, RUN)
    assert shown.startswith("2 of 2 runs")
    assert "2: terfenol_uncompensated.mcap" in shown


@pytest.fixture(scope="module")
def axes(tmp_path_factory):
    """Two axes of a run on a circle, and a run of another, in one folder."""
    folder = tmp_path_factory.mktemp("axes")
    sine = {"kind": "sine", "unit": "um", "amplitude": 20.0, "frequency_hz": 50.0}
    sine |= {"offset": -6.9, "duration_s": 0.26, "soft_start_s": 0.2, "soft_end_s": 0.0}
    phases = {"x": 90.0, "y": 0.0}
    settings = {name: {"waveform": sine | {"phase_deg": each}} for name, each in phases.items()}
    run_of_axes(CONFIGS / "demo.yaml", folder, {"x": settings["x"], "z": settings["y"]}, "other")
    (folder / "no.mcap").write_text("hello")
    return run_of_axes(CONFIGS / "demo.yaml", folder, settings)


def test_axes_of_a_run_have_one_report(axes, tmp_path, hilctl, json_of):
    """From any recording of the run, or from all of them in any order."""
    page = tmp_path / "page.html"
    code, found = json_of("report", axes["y"], "--html", page)
    assert (code, list(found["axes"])) == (0, ["x", "y"])
    assert 0.05 < found["peak_um"] < 1.0
    assert found["samples"] == found["segments"][0]["samples"] == 2000
    assert json_of("report", axes["y"], axes["x"])[1] == found
    assert "contour error" in page.read_text(encoding="utf-8")
    assert api.contour(axes["x"]).to_mapping() == found
    shown = hilctl("report", axes["x"], "--from", "0.22", "--to", "0.25")[1]
    assert "contour error" in shown
    assert "axis y" in shown
    assert hilctl("report", axes["x"], "--html", page)[0] == 2


def test_recordings_that_are_no_axes_of_one_run(axes, tmp_path, hilctl, json_of, caplog):
    other = axes["x"].with_name("other.z.mcap")
    assert "runs" in json_of("report", axes["x"], other)[1]
    alone = shutil.copy(axes["x"], tmp_path)
    assert "peak_error_percent" in json_of("report", alone)[1]
    assert "y" in caplog.records[-1].getMessage()
    with pytest.raises(InputError):
        api.contour(alone)
    assert hilctl("report", axes["x"], "--html", tmp_path / "p.html", "--before", other)[0] == 2
    assert not (tmp_path / "p.html").exists()


def test_folder_is_one_page(tmp_path, monkeypatch, hilctl):
    monkeypatch.setattr(html, "drawn", lambda sheet: None)
    monkeypatch.setattr(html, "svg", lambda figure, text: f'<svg aria-label="{text}"></svg>')
    words = ("report", GOLDEN, "--html", tmp_path / "page.html")
    assert "3 of 3 runs" in hilctl(*words)[1]
    assert "3 of 3 runs completed" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert hilctl(*words)[0] == 2


def test_figures_are_written_to_a_folder(tmp_path, json_of):
    folder = tmp_path / "runs"
    folder.mkdir()
    for name in ("terfenol_uncompensated", "terfenol_compensated"):
        shutil.copy(GOLDEN / f"{name}.mcap", folder)
    _, found = json_of("figures", folder, "--format", "svg", "--width", "single")
    written = [Path(name) for name in found["figures"]]
    assert written
    assert all(path.parent == folder / "figures" and path.is_file() for path in written)


def test_unreadable_runs_are_listed_without_control_characters(capsys):
    runs = (grown(3.0, 10.0), grown(3.0, 100.0, 2))
    missing = ("lost.mcap: \x1b[2J[bold]no such file",)
    print_rich(render_series(RunSeries("[red]two", runs, ("waveform.frequency_hz",), missing)))
    shown = capsys.readouterr().out
    assert shown.startswith("2 of 2 runs")
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


@pytest.mark.parametrize(("result", "other", "texts"), [
    (SAME, None, ["identical: 900 commands"]),
    (OTHER, None, ["different: 3 of 900 commands", "sample 12", "largest difference 0.5 A"]),
    (SAME, "m.yaml", ["m.yaml", "-1.5 to 2.25 A", "7 samples"]),
    (replace(SAME, left_out_samples=50), None, ["50 samples after a gap", "identical"]),
])  # fmt: skip
def test_differences_of_a_replay_are_printed(monkeypatch, capsys, result, other, texts):
    monkeypatch.setenv("COLUMNS", "120")
    print_replay(result, other=other)
    shown = capsys.readouterr().out
    assert [each for each in texts if each not in shown] == []
    assert ("identical" in shown) == (other is None and result.identical)
