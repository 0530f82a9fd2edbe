"""Commands without a device work on systems without Linux-only modules and file semantics."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFIGS, GOLDEN = ROOT / "configs", ROOT / "recordings" / "golden"
UNCOMPENSATED = str(GOLDEN / "terfenol_uncompensated.mcap")
COMPENSATED = str(GOLDEN / "terfenol_compensated.mcap")
OTHER_SYSTEM = ROOT / "tests" / "data" / "other_system.py"

SYSTEMS = ["win32", "darwin"] if sys.platform == "linux" else [sys.platform]
"""Linux imitates the others; those are themselves."""


def on(system, commands, folder):
    """Run commands as on another system; return their exit codes and standard error."""
    done = subprocess.run(
        [sys.executable, "-P", OTHER_SYSTEM, system],
        input=json.dumps(commands),
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, "PYTHONIOENCODING": "cp1252"} if system == "win32" else None,
        cwd=folder,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_the_offline_half_works(tmp_path, system):
    runs, torn = tmp_path / "runs", tmp_path / "torn.mcap"
    runs.mkdir()
    shutil.copy(UNCOMPENSATED, runs)
    shutil.copy(COMPENSATED, runs)
    torn.write_bytes(Path(COMPENSATED).read_bytes()[:-1000])
    sine = ["waveform.duration_s=0.6", "waveform.soft_start_s=0.1", "waveform.frequency_hz=100"]
    commands = [
        ["list", str(GOLDEN)],
        ["list", str(runs), "--json"],
        ["report", COMPENSATED, "--html", "page.html"],
        ["report", str(runs), "--html", "pages.html"],
        ["replay", COMPENSATED],
        ["export", COMPENSATED, "table.csv"],
        ["export", COMPENSATED, "table.csv", "--overwrite"],
        ["recover", str(torn)],
        ["recover", UNCOMPENSATED, "--output", "recovered.mcap"],
        ["figures", str(runs)],
        ["identify", UNCOMPENSATED, "--model", "straight", "--output", "model.yaml"],
        ["identify", UNCOMPENSATED, "--model", "rdpi", "--output", "rdpi.yaml"],
        ["compare", UNCOMPENSATED, "--models", "straight,spi"],
        ["sweep", str(CONFIGS / "piezo_sine.yaml"), "--vary", "waveform.amplitude=1,2", "--fast",
         "--folder", "sweep", "--set", "waveform.duration_s=0.6"],
        ["check", str(CONFIGS / "demo.yaml")],
        ["init", "simulated_piezo"],
        ["examples"],
        ["examples", "demo"],
        ["devices"],
        ["schema", "--output", "schema.json"],
        ["learn", str(CONFIGS / "terfenol_sine_6a.yaml"), "--fast", "--cycles", "1",
         "--output", "correction.yaml", *[word for each in sine for word in ("--set", each)]],
    ]  # fmt: skip
    codes, said = on(system, commands, tmp_path)
    assert codes == [0] * len(commands), said
    for name in ("page.html", "table.csv", "model.yaml", "schema.json", "correction.yaml"):
        assert (tmp_path / name).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_the_online_half_says_what_it_needs(tmp_path, system):
    """Commands that need Linux end with one line and exit code 2 or 3."""
    demo = str(CONFIGS / "demo.yaml")
    commands = [["run", demo], ["demo"], ["doctor"], ["live"], ["safe", demo],
                ["devices", "probe", demo]]  # fmt: skip
    if system == "win32":
        commands.append(["emulate", "labjack_t7"])  # whose serial lines are pseudo-terminals
    codes, said = on(system, [["--platform"], *commands], tmp_path)
    assert codes == [2, 2, 2, 2, 2, 2, 3][: len(commands)], said
    lines = [line for line in said.splitlines() if not line.startswith("---")]
    assert len(lines) == len(commands)
    for line in lines[:6]:
        assert line.startswith(f"hilctl: a run needs Linux, this is {system}: report, replay")
    assert not list(tmp_path.iterdir())
