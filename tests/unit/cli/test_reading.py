"""Commands that read recordings: what they print for programs and which exit code they give."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from hilctl.analysis import replay as replaying
from hilctl.base.errors import InputError
from hilctl.cli.commands import load
from hilctl.cli.reading import export, replay, report
from hilctl.cli.recordings import recover

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


@pytest.fixture
def recording(tmp_path):
    return Path(shutil.copy(GOLDEN, tmp_path / "run.mcap"))


def read_recording(name, words):
    return load(name)(words, standalone_mode=False) or 0


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


def test_words_become_what_a_command_takes(recording, tmp_path, capsys):
    """Options may stand between and before what a command is about."""
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
        (["run.mcap", "--before", "run.mcap"], "name one with --html"),
        (["run.mcap", "--model", "model.yaml"], "--model is for the report of several"),
        (["run.mcap", "run.mcap", "--from", "1"], "are for the report of one"),
    ],
)
def test_options_that_do_not_go_together(words, text):
    with pytest.raises(InputError, match=text):
        read_recording("report", words)
