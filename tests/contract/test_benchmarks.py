"""Every benchmark can still be run: what it imports is there."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BENCHMARKS = sorted(path.stem for path in (ROOT / "tests" / "benchmark").glob("*.py"))


@pytest.mark.slow
def test_what_benchmarks_import_is_there():
    imports = "; ".join(f"import tests.benchmark.{name}" for name in BENCHMARKS)
    words = [sys.executable, "-c", imports]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
