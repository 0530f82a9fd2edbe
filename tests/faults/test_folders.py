"""Where hilctl is run from does not matter, whatever lies there."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TRAPS = ("signal", "json", "numpy", "yaml", "struct", "hilctl", "hilctl_drivers", "mmap", "queue")


def run(folder, tmp_path, *settings):
    program = Path(sys.executable).parent / "hilctl"
    command = [program, "run", ROOT / "configs" / "demo.yaml", "--json", "--overwrite"]
    command += ["--output", tmp_path / "run.mcap", "--set", "waveform.duration_s=0.5"]
    return subprocess.run(
        [*map(str, command), *settings], cwd=folder, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize("name", ["-a: lab #3 [x] 50 % {y}\n\"ü'"])
def test_folder_of_any_name(tmp_path, name):
    """A run is started there, and records there."""
    folder = tmp_path / name
    folder.mkdir()
    ended = run(folder, folder)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["code"] == "completed"


def test_modules_of_the_lab_are_never_imported(tmp_path):
    """A file of the name of a module is not taken for it, in any of hilctl's processes."""
    sprung = tmp_path / "sprung"
    for name in TRAPS:
        text = f"open({str(sprung)!r}, 'a').write({name!r} + chr(10)); raise SystemExit({name!r})"
        (tmp_path / f"{name}.py").write_text(text)
    ended = run(tmp_path, tmp_path)
    assert not sprung.exists(), sprung.read_text()
    assert ended.returncode == 0, ended.stderr


def test_from_above_the_checkout():
    """Folders there are called as packages are; they must not be taken for them."""
    code = "import hilctl, hilctl_drivers; print(hilctl.__version__)"
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, cwd=ROOT.parent, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
