"""Damaged and crafted recordings: accepted, or refused in words; no kernel leaves its arrays.

``python -m tests.benchmark.mutated_recordings 10000`` gives thousands of them to every command.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmark.mutated_recordings import mutant, outcomes

ROOT = Path(__file__).parents[2]
FILES = 40
CHECKED = """
import runpy, sys
import numpy as np
from hilctl.kernels.hysteresis import play_sum

try:
    play_sum(np.zeros(4), 0.0, 1.0, np.ones(3), np.ones(3), np.zeros(1), np.zeros(4))
except IndexError:
    pass
else:
    sys.exit("the kernels were compiled without bounds checks")
sys.argv[1:] = ["60", "--seed", "7", "--commands", "replay,initial_state,pieces"]
runpy.run_module("tests.benchmark.mutated_recordings", run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_mutated_recordings_are_refused_in_words(tmp_path: Path, part: int) -> None:
    """No crash, no hang, no warning of numpy; what is recovered is sound."""
    path = tmp_path / "mutant.mcap"
    found = []
    for number in range(part, FILES, 4):
        path.write_bytes(mutant(number, seed=3))
        commands = ("report", "replay", "pieces", "identify", "initial_state", "export")
        results = list(outcomes(path, commands if number % 8 == 0 else commands[:-1]))
        defects = [(name, text) for name, how, text in results if how not in {"done", "refused"}]
        assert not defects, f"file {number}: {defects[0][0]}\n{defects[0][1]}"
        found += [how for _, how, _ in results]
    assert {"done", "refused"} <= set(found)


@pytest.mark.slow
def test_kernels_stay_within_their_arrays(request: pytest.FixtureRequest) -> None:
    """Compiled with bounds checks, in a cache of their own, they find nothing to say."""
    cache = request.config.cache.mkdir("kernels-with-bounds-checks")
    checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", CHECKED]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **checked}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "replay done" in done.stdout
