"""The working folder and its contents do not affect a run."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from tests.commands import ended, typed
from tests.faults.conftest import EXPERIMENT

ROOT = Path(__file__).parents[2]
TRAPS = ("signal", "json", "numpy", "yaml", "struct", "hilctl", "hilctl_drivers", "mmap", "queue")


def run(folder):
    program = Path(sys.executable).parent / "hilctl"
    command = [program, "run", ROOT / "configs" / "demo.yaml", "--json", "--overwrite"]
    command += ["--output", folder / "run.mcap", "--set", "waveform.duration_s=0.5"]
    return ended(command, cwd=folder)


def test_folder_of_any_name_and_content(tmp_path):
    """A run starts and records there; no process imports local files with names of modules."""
    folder, sprung = tmp_path / "-a: lab #3 [x] 50 % {y}\n\"ü'", tmp_path / "sprung"
    folder.mkdir()
    for name in TRAPS:
        text = f"open({str(sprung)!r}, 'a').write({name!r} + chr(10)); raise SystemExit({name!r})"
        (folder / f"{name}.py").write_text(text)
    assert json.loads(run(folder).stdout)["code"] == "completed"
    assert not sprung.exists(), sprung.read_text()


def test_from_above_the_checkout():
    """Folders with names of packages are not imported."""
    code = "import hilctl, hilctl_drivers; print(hilctl.__version__)"
    ended([sys.executable, "-c", code], cwd=ROOT.parent)


GONE = 'mkdir gone; cd gone; rmdir ../gone; exec "$@"'


@pytest.mark.parametrize(("experiment", "output", "code", "said"), [
    ("demo.yaml", "/run.mcap", 3, "the working folder has been deleted: change"),
    ("/demo.yaml", "run.mcap", 2, "run.mcap: cannot be written: No such file or directory"),
    pytest.param("/demo.yaml", "/run.mcap", 0, "", marks=pytest.mark.long),
])  # fmt: skip
def test_working_folder_that_is_gone_before_the_start(tmp_path, experiment, output, code, said):
    """Relative paths are rejected with one message; a run without relative paths completes."""
    shutil.copy(ROOT / "configs" / "demo.yaml", tmp_path)
    shutil.copytree(ROOT / "configs" / "models", tmp_path / "models")
    names = [f"{tmp_path}{each}" if each[0] == "/" else each for each in (experiment, output)]
    command = typed("run", names[0], "--output", names[1], "--set", "waveform.duration_s=0.5")
    errors = ended(["sh", "-c", GONE, "sh", *command], code, cwd=tmp_path).stderr
    assert said in errors
    assert len(errors.splitlines()) == (code != 0)
    assert (tmp_path / "run.mcap").exists() == (code == 0)


@pytest.mark.parametrize("inside", [False, True])
def test_folder_that_is_deleted_while_a_run_starts(tmp_path, device, inside):
    """A folder deleted with the new recording ends the start with one message; nothing moves."""
    (tmp_path / "e.yaml").write_text(yaml.safe_dump({**EXPERIMENT, "device": device.section}))
    lab = tmp_path / "lab"
    lab.mkdir()
    output = "run.mcap" if inside else lab / "run.mcap"
    command = typed("run", tmp_path / "e.yaml", "--output", output)
    with subprocess.Popen(
        command, cwd=lab if inside else tmp_path, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 240.0
        while not (lab / "run.mcap").exists():
            assert time.monotonic() < deadline
            time.sleep(0.002)
        shutil.rmtree(lab)
        _, err = process.communicate(timeout=240)
    # Which of the two is noticed first depends on timing.
    gone = "hilctl: the working folder has been deleted: change to another one"
    taken = "run.mcap: cannot be written: the file was deleted or renamed"
    (line,) = err.splitlines()
    assert line.endswith(taken) or (inside and line == gone)
    assert process.returncode in {2, 3}
    assert not lab.exists()
    assert device.has_not_moved()
