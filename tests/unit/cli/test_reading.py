"""Commands that read recordings: what they print for programs and which exit code they give."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.analysis import replay as replaying
from hilctl.base.errors import InputError
from hilctl.cli.commands import load
from hilctl.cli.reading import export, read_recording, replay, report
from hilctl.cli.recordings import recover

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
    assert replay(recording, as_json=True) == 1


def test_all_recordings_of_a_folder_are_exported(tmp_path, monkeypatch, capsys):
    """What is left out is said, and ends with one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = Path(shutil.copytree(GOLDEN.parent, tmp_path / "recordings"))
    export(folder, tmp_path / "out", every=True)
    assert "3 recordings written, 0 were there already" in capsys.readouterr().out
    (folder / "no.mcap").write_text("hello")
    assert export(folder, tmp_path / "out", every=True, as_json=True) == 1
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


@pytest.mark.parametrize("words", [["report"], ["replay"], ["export", "run.mcap"]])
def test_what_is_missing_is_said(words, capsys):
    with pytest.raises(SystemExit) as left:
        load(words[0])(words[1:], standalone_mode=False)
    assert left.value.code == 2
    assert f"usage: hilctl {words[0]}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "left_out"),
    [
        (["report"], ["typer", "pydantic", "scipy.special", "pyarrow", "matplotlib"]),
        (["export", "run.npz"], ["typer", "rich", "pydantic", "pyarrow", "scipy.special"]),
        (["replay"], ["typer", "pyarrow", "matplotlib"]),
    ],
)
def test_each_imports_what_it_needs(words, left_out, recording):
    """Importing takes longer than reading a minute at 50 kHz."""
    code = """
import sys
from hilctl.cli import main
left_out, sys.argv[1:] = sys.argv[1].split(","), sys.argv[2:]
try:
    main()
finally:
    print([each for each in left_out if each in sys.modules])
"""
    name, *output = words
    command = [sys.executable, "-c", code, ",".join(left_out), name, recording.name, *output]
    ended = subprocess.run(
        command, capture_output=True, text=True, timeout=120, cwd=recording.parent
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1] == "[]"
