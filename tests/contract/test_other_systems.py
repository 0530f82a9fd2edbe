"""What needs no device works where Python has none of the modules that only Linux gives it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFIGS, GOLDEN = ROOT / "configs", ROOT / "recordings" / "golden"
UNCOMPENSATED = str(GOLDEN / "terfenol_uncompensated.mcap")
COMPENSATED = str(GOLDEN / "terfenol_compensated.mcap")
ELSEWHERE = """
import json, os, sys
import serial  # it has a part of its own for each system

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

NAMES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
for name in NAMES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())
for name in ("fork", "geteuid", "getuid", "posix_fallocate", "sched_setscheduler", "O_NOFOLLOW"):
    delattr(os, name)

from hilctl.cli import main

codes = {}
for words in json.load(sys.stdin):
    sys.argv = ["hilctl", *words]
    print(f"--- {words[0]}", file=sys.stderr, flush=True)
    try:
        main()
    except SystemExit as ended:
        codes[words[0]] = ended.code or 0
print(json.dumps(codes))
"""


def elsewhere(code: str, commands: list[list[str]], folder: Path) -> tuple[dict[str, int], str]:
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@pytest.mark.slow
def test_the_offline_half_works(tmp_path: Path) -> None:
    sine = ["waveform.duration_s=0.6", "waveform.soft_start_s=0.1", "waveform.frequency_hz=100"]
    commands = [
        ["report", COMPENSATED, "--html", "page.html"],
        ["replay", COMPENSATED],
        ["export", COMPENSATED, "table.csv"],
        ["identify", UNCOMPENSATED, "--model", "straight", "--output", "model.yaml"],
        ["list", str(GOLDEN)],
        ["check", str(CONFIGS / "demo.yaml")],
        ["schema", "--output", "schema.json"],
        ["compare", UNCOMPENSATED, "--models", "straight"],
        ["learn", str(CONFIGS / "terfenol_sine_6a.yaml"), "--fast", "--cycles", "1",
         "--output", "correction.yaml", *[word for each in sine for word in ("--set", each)]],
    ]  # fmt: skip
    codes, said = elsewhere(ELSEWHERE, commands, tmp_path)
    assert codes == {words[0]: 0 for words in commands}, said
    for name in ("page.html", "table.csv", "model.yaml", "schema.json", "correction.yaml"):
        assert (tmp_path / name).stat().st_size > 0


@pytest.mark.slow
def test_the_online_half_says_what_it_needs(tmp_path: Path) -> None:
    """In one line, and exit code 2 or 3."""
    commands = [["run", str(CONFIGS / "demo.yaml")], ["emulate", "labjack_t7"]]
    # Once numba is loaded: it asks as well where it is.
    mac = "import hilctl.run.start\nsys.platform = 'darwin'\ncodes = {}"
    code = ELSEWHERE.replace("codes = {}", mac)
    codes, said = elsewhere(code, commands, tmp_path)
    assert codes == {"run": 2, "emulate": 3}, said
    lines = [line for line in said.splitlines() if not line.startswith("---")]
    assert len(lines) == 2
    assert lines[0].startswith("hilctl: a run needs Linux, this is darwin: report, replay")
    assert lines[1].startswith("hilctl: this needs Linux, whose 'pty' is not here: report, replay")
    assert not list(tmp_path.iterdir())
