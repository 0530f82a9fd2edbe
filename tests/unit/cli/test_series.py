"""Commands about many runs."""

import json
import shutil
from pathlib import Path

import pytest

from hilctl.analysis import html
from hilctl.base.errors import InputError
from hilctl.cli.reading import report
from hilctl.cli.series import figures

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
RUN = GOLDEN / "terfenol_uncompensated.mcap"


def test_several_runs_make_one_object_or_a_table(capsys):
    report([RUN, RUN], as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["headline"].startswith("2 runs, all completed.")
    assert [run["recording"] for run in found["runs"]] == [RUN.name] * 2
    report([RUN, RUN])
    shown = capsys.readouterr().out
    assert shown.startswith("2 runs, all completed.")
    assert "2: terfenol_uncompensated.mcap" in shown


def test_a_folder_makes_one_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(html, "drawn", lambda sheet: None)
    monkeypatch.setattr(html, "svg", lambda figure: "<svg></svg>")
    page = tmp_path / "page.html"
    report([GOLDEN], html=page)
    assert "runs, all completed" in page.read_text(encoding="utf-8")
    assert "all completed" in capsys.readouterr().out
    with pytest.raises(InputError, match="exists already"):
        report([GOLDEN], html=page)


def test_options_of_one_recording_are_refused_for_many():
    with pytest.raises(InputError, match="--from, --to and --before"):
        report([RUN, RUN], from_s=1.0)
    with pytest.raises(InputError, match="--model is for"):
        report([RUN], model=Path("x.yaml"))
    with pytest.raises(InputError, match="name one with --html"):
        report([RUN], before=RUN)


def test_figures_go_to_a_folder(tmp_path, capsys):
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
