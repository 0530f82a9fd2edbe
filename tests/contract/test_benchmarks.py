"""Every benchmark script starts and prints its options."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(
    path.stem
    for path in (ROOT / "tests" / "benchmark").glob("*.py")
    if "def main(" in path.read_text(encoding="utf-8")
)
HELP = """
import runpy, sys
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    try:
        runpy.run_module(f"tests.benchmark.{name}", run_name="__main__")
    except SystemExit as end:
        assert end.code == 0, name
    else:
        raise AssertionError(name)
"""


@pytest.mark.slow
def test_every_script_answers_help():
    command = [sys.executable, "-c", HELP, *SCRIPTS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(SCRIPTS) > 0
