"""Machines with few resources, or with obstacles from other users: a run, or one message."""

import json
import os
import subprocess
import sys

import pytest
import yaml

from tests import commands

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
    """Return a function that runs ``hilctl run`` in a shell command, in a separate folder."""

    def run(shell='"$@"', output="run.mcap", folder=tmp_path, changes=None, **environment):
        text = yaml.safe_dump({**EXPERIMENT, **(changes or {})})
        (tmp_path / "e.yaml").write_text(text, encoding="utf-8")
        command = ["sh", "-c", shell, "sh", sys.executable, "-P", "-m", "hilctl", "run"]
        command += [str(tmp_path / "e.yaml"), "--output", str(output), "--overwrite"]
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=240,
            env={**os.environ, **environment},
        )  # fmt: skip
        assert "Traceback" not in ended.stderr
        return ended

    return run


@pytest.mark.parametrize(("shell", "environment"), [
    ('ulimit -n 32; umask 077; unset HOME TERM; "$@"', {}),
    ('umask 0; "$@" | head -c 1', {}),
    ('"$@" >&- 2>&- <&-', {}),
    ('"$@"', {"COLUMNS": "1", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
], ids=["private", "head", "closed", "no locale"])  # fmt: skip
def test_run_with_few_resources_completes(hilctl, tmp_path, shell, environment):
    """A run completes with few file descriptors, no home, no terminal and no reader."""
    ended = hilctl(shell, **environment)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "run.mcap").stat().st_size > 1000


@pytest.mark.parametrize("shell", ['ulimit -n 9; "$@"', 'ulimit -v 300000; "$@"'])
def test_missing_resources_are_one_message(hilctl, tmp_path, shell):
    """Too few descriptors or too little memory: one message, no motion, no recording."""
    ended = hilctl(shell)
    assert ended.returncode == 3, ended.stderr
    assert ended.stderr.startswith("hilctl: ")
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize(
    ("size", "seconds", "file"), [("4k", 0.1, "ring"), ("1m", 500.0, "reference.npy")]
)
def test_too_little_shared_memory_is_one_message(hilctl, own_mounts, size, seconds, file, device):
    """Too little shared memory for ring or samples is named."""
    small = f'mount -t tmpfs -o size={size} none /dev/shm; "$@"'
    shell = own_mounts(f"{small}; code=$?; ls -A -I devices /dev/shm/runs; exit $code")
    waveform = {**EXPERIMENT["waveform"], "duration_s": seconds}
    changes = {"device": device.section, "sample_rate_hz": 500, "block": 1, "waveform": waveform}
    ended = hilctl(shell, changes=changes, HILCTL_RUNS="/dev/shm/runs")
    assert ended.returncode == 3, ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert f"/{file}: " in ended.stderr
    assert "reduce recording.ring_s" in ended.stderr
    assert ended.stdout == ""
    assert device.has_not_moved()


def test_a_megabyte_of_shared_memory_is_enough_for_a_small_run(hilctl, own_mounts, tmp_path):
    shell = own_mounts('mount -t tmpfs -o size=1m none /dev/shm; "$@"')
    ended = hilctl(shell, HILCTL_RUNS="/dev/shm/runs")
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "run.mcap").stat().st_size > 1000


@pytest.mark.parametrize("before", [False, True], ids=["new", "overwrite"])
def test_a_full_disk_at_the_start_is_one_message(hilctl, own_mounts, tmp_path, before, device):
    """A full disk at the start: no motion, no file."""
    (tmp_path / "disk").mkdir()
    full = 'mount -t tmpfs -o size=64k none disk; cat /dev/zero > disk/full 2> /dev/null; "$@"'
    shell = own_mounts(f"{full}; code=$?; ls disk; exit $code")
    if before:
        shell = shell.replace("cat", "touch disk/run.mcap; cat", 1)
    changes = {"device": device.section, "sample_rate_hz": 500, "block": 1}
    ended = hilctl(shell, output="disk/run.mcap", changes=changes)
    assert ended.returncode == 2, ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert ended.stderr.startswith("hilctl: disk/run.mcap: ")
    assert "No space left" in ended.stderr
    assert ended.stdout.split() == ["full", *["run.mcap"][:before]]
    assert device.has_not_moved()


@pytest.mark.parametrize(("what", "second"), [
    ("mkdir -m 777", False),
    ("ln -s $PWD/mine", False),
    ("mkfifo", False),
    ("ln -s $PWD/mine", True),
])  # fmt: skip
def test_obstacles_of_another_user_are_reported(hilctl, own_mounts, tmp_path, nobody, what, second):
    """Files of another user are neither used nor followed; the run avoids or names them."""
    (tmp_path / "mine").mkdir(mode=0o700)
    place, other = f"/dev/shm/hilctl-{os.geteuid()}", f"/run/user/{os.geteuid()}"
    shell = own_mounts(
        "mount -t tmpfs -o mode=1777 none /dev/shm; mount -t tmpfs none /run; unset HILCTL_RUNS; "
        f"{' '.join(nobody)} {what} {place}; {f'mkdir -p -m 700 {other};' * second} "
        f'"$@"; code=$?; find {place}/ mine -mindepth 1 2> /dev/null; exit $code'
    )
    ended = hilctl(shell)
    assert ended.returncode == (0 if second else 3), ended.stderr
    assert (tmp_path / "run.mcap").exists() == second
    assert not list((tmp_path / "mine").iterdir())
    if not second:
        assert ended.stdout == ""
        assert len(ended.stderr.splitlines()) == 1
        assert f"folder for runs: {place}: " in ended.stderr
        assert "HILCTL_RUNS" in ended.stderr


def test_device_folder_of_another_user_is_not_followed(hilctl, tmp_path):
    """A link in place of a lock file is not followed."""
    theirs = tmp_path / "theirs"
    theirs.mkdir(mode=0o700)
    (tmp_path / "runs").symlink_to(theirs)
    ended = hilctl(HILCTL_RUNS=str(tmp_path / "runs"))
    assert ended.returncode == 3
    assert "folder for runs" in ended.stderr
    assert not list(theirs.iterdir())
    assert not (tmp_path / "run.mcap").exists()


def test_markup_and_control_characters_in_a_name_are_escaped(hilctl, tmp_path):
    """Markup and escapes in a folder's name neither end a run nor reach the terminal."""
    folder = tmp_path / "[x] \x1b[31m" / "[" / "x]"
    folder.mkdir(parents=True)
    ended = hilctl(output=folder / "run.mcap", COLUMNS="300")
    assert ended.returncode == 0, ended.stderr
    assert r"[x] \x1b[31m/[/x]/run.mcap" in ended.stdout
    assert "\x1b" not in ended.stdout + ended.stderr


def test_errors_in_programs_name_the_experiment(tmp_path):
    """With --json the message is plain text in JSON."""
    ended = commands.hilctl("report", "\x1b[2J[/x].mcap", "--json", code=2, cwd=tmp_path)
    assert json.loads(ended.stdout)["error"].startswith("\x1b[2J[/x].mcap: ")
    assert "\x1b" not in ended.stdout + ended.stderr
