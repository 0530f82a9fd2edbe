"""Machines that have little, and what others have left on them: hilctl runs, or says why not."""

import json
import os
import subprocess
import sys

import pytest
import yaml

EXPERIMENT = {
    "name": "poor",
    "device": {"kind": "simulated_terfenol"},
    "sample_rate_hz": 1000,
    "block": 10,
    "waveform": {"kind": "hold", "unit": "A", "level": 0.0, "duration_s": 0.1},
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": 0.1},
}


@pytest.fixture
def hilctl(tmp_path):
    """Return a function that runs a shell's words around ``hilctl run``, in a folder of its own."""
    (tmp_path / "e.yaml").write_text(yaml.safe_dump(EXPERIMENT), encoding="utf-8")

    def run(shell='"$@"', output="run.mcap", folder=tmp_path, **environment):
        command = ["sh", "-c", shell, "sh", sys.executable, "-P", "-m", "hilctl.cli", "run"]
        command += [str(tmp_path / "e.yaml"), "--output", str(output), "--overwrite"]
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=240,
            env={**os.environ, **environment},
        )  # fmt: skip
        assert "Traceback" not in ended.stderr
        return ended

    return run


@pytest.mark.parametrize(
    ("shell", "environment"),
    [
        ('ulimit -n 32; "$@"', {}),
        ('umask 077; "$@"', {}),
        ('umask 0; "$@"', {}),
        ('unset HOME TERM; "$@"', {}),
        ('"$@" | head -c 1', {}),
        ('"$@" >&- 2>&- <&-', {}),
        ('"$@"', {"COLUMNS": "1", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    ],
    ids=["32 files", "umask 077", "umask 0", "no home", "head", "closed", "no locale"],
)
def test_runs_with_little(hilctl, tmp_path, shell, environment):
    """Few files, no terminal, nobody who reads: the run is whole."""
    ended = hilctl(shell, **environment)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "run.mcap").stat().st_size > 1000


@pytest.mark.parametrize("name", ["/dev/null", "/dev/full", "/proc/x.mcap", "fifo", ".", "no/x"])
def test_output_that_is_no_file_is_refused(hilctl, tmp_path, name):
    """In one message, and nothing stands there afterwards that did not before."""
    os.mkfifo(tmp_path / "fifo")
    before = sorted(tmp_path.iterdir())
    ended = hilctl(output=name)
    assert ended.returncode == 2, ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert name in ended.stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("shell", ['ulimit -n 9; "$@"', 'ulimit -v 300000; "$@"'])
def test_too_little_is_one_message(hilctl, tmp_path, shell):
    """Descriptors or memory: nothing has moved, and no recording is left."""
    ended = hilctl(shell)
    assert ended.returncode == 3, ended.stderr
    assert ended.stderr.startswith("hilctl: ")
    assert not (tmp_path / "run.mcap").exists()


def test_device_folder_of_somebody_else_is_not_written_through(hilctl, tmp_path):
    """Where locks once stood, a link leads to a file of the user's: it stays as it is."""
    theirs = tmp_path / "theirs"
    theirs.mkdir(mode=0o700)
    (tmp_path / "runs").symlink_to(theirs)
    ended = hilctl(HILCTL_RUNS=str(tmp_path / "runs"))
    assert ended.returncode == 3
    assert "no folder for runs" in ended.stderr
    assert not list(theirs.iterdir())
    assert not (tmp_path / "run.mcap").exists()


def test_a_name_full_of_markup_and_escapes_is_shown_as_it_is(hilctl, tmp_path):
    """What a folder is called neither ends a run nor reaches the terminal."""
    folder = tmp_path / "[x] \x1b[31m" / "[" / "x]"
    folder.mkdir(parents=True)
    ended = hilctl(output=folder / "run.mcap", COLUMNS="300")
    assert ended.returncode == 0, ended.stderr
    assert r"[x] \x1b[31m/[/x]/run.mcap" in ended.stdout
    assert "\x1b" not in ended.stdout + ended.stderr


def test_errors_of_programs_name_it_too(tmp_path):
    """With --json the message is JSON, and as plain."""
    command = [sys.executable, "-P", "-m", "hilctl.cli", "report", "\x1b[2J[/x].mcap", "--json"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2
    assert json.loads(ended.stdout)["error"].startswith("\x1b[2J[/x].mcap: ")
    assert "\x1b" not in ended.stdout + ended.stderr
