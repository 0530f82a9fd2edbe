"""Commands about recordings: what they print for programs and which exit code they give."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from hilctl.analysis import replay as replaying
from hilctl.base.errors import InputError
from hilctl.cli.recordings import _column, export, recover, replay, report

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


@pytest.fixture
def recording(tmp_path):
    return Path(shutil.copy(GOLDEN, tmp_path / "run.mcap"))


def printed(capsys):
    return json.loads(capsys.readouterr().out)


def test_report_replay_recover_and_export_agree_on_the_samples(recording, tmp_path, capsys):
    """One object each, on standard output, of one recording."""
    report([recording], as_json=True)
    samples = printed(capsys)["recorded_samples"]
    replay(recording, as_json=True)
    assert printed(capsys)["samples"] == samples
    recover(recording, as_json=True)
    assert printed(capsys)["samples"] == samples
    export(recording, tmp_path / "run.csv", as_json=True)
    assert printed(capsys) == {"output": str(tmp_path / "run.csv"), "rows": samples}
    assert len((tmp_path / "run.csv").read_text().splitlines()) == samples + 1


def test_a_replay_that_differs_ends_with_one(recording, monkeypatch):
    """A script notices without reading."""
    found = replaying.replay

    def different(recording, model):
        return replace(found(recording, model), identical=False, first_difference=0)

    monkeypatch.setattr(replaying, "replay", different)
    with pytest.raises(typer.Exit) as ended:
        replay(recording, as_json=True)
    assert ended.value.exit_code == 1


@pytest.mark.parametrize(("text", "column"), [("3", 3), ("drive", "drive"), (None, None)])
def test_a_column_is_a_number_or_a_name(text, column):
    assert _column(text) == column


def test_all_recordings_of_a_folder_are_exported(tmp_path, monkeypatch, capsys):
    """What is left out is said, and ends with one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = Path(shutil.copytree(GOLDEN.parent, tmp_path / "recordings"))
    export(folder, tmp_path / "out", every=True)
    assert "3 recordings written, 0 were there already" in capsys.readouterr().out
    (folder / "no.mcap").write_text("hello")
    with pytest.raises(typer.Exit) as ended:
        export(folder, tmp_path / "out", every=True, as_json=True)
    assert ended.value.exit_code == 1
    found = printed(capsys)
    assert (found["written"], found["there"], list(found["left_out"])) == (0, 3, ["no.mcap"])
    with pytest.raises(InputError, match="--all: writes whole recordings"):
        export(folder, tmp_path / "out", every=True, overwrite=True)
