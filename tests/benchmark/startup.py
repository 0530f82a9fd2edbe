"""Time from the command to the first sample, with and without cached kernels.

Run it with ``python -m tests.benchmark.startup``; see README.md beside it.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

from hilctl.recording.run_summary import read_ends

CONFIG = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"


def first_sample_s(experiment: Path, folder: Path, environment: dict[str, str]) -> float:
    """Run an experiment for a moment; return the time from its command to its first sample."""
    output = folder / "run.mcap"
    words = [sys.executable, "-m", "hilctl", "run", str(experiment), "--overwrite", "--quiet"]
    words += ["--output", str(output), "--set", "waveform.duration_s=1.0"]
    began_s = time.time()
    ran = subprocess.run(words, capture_output=True, text=True, env={**os.environ, **environment})
    if ran.returncode:
        sys.exit(f"the run failed: {ran.stderr.strip()}")
    return datetime.fromisoformat(read_ends(output).run["started"]).timestamp() - began_s


def judged(name: str, took_s: list[float], most_s: float) -> bool:
    """Print what was measured; return whether the median is within the limit."""
    median_s = statistics.median(took_s)
    each = " ".join(f"{value:.2f}" for value in took_s)
    print(f"{name}: first sample after {median_s:.2f} s ({each}), at most {most_s:g} s: "
          f"ratio {median_s / most_s:.2f}", flush=True)  # fmt: skip
    return median_s <= most_s


def main() -> int:
    """Run the benchmark; the exit code is 1 where a median is above its limit."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--experiment", type=Path, default=CONFIG)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--max-warm-s", type=float, default=2.5)
    parser.add_argument("--max-cold-s", type=float, default=15.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Bytecode is kept for both, whatever the surroundings say.
        caches = {"PYTHONPYCACHEPREFIX": str(folder / "bytecode"), "PYTHONDONTWRITEBYTECODE": ""}
        caches["NUMBA_CACHE_DIR"] = str(folder / "kernels")
        first_sample_s(options.experiment, folder, caches)  # fills them
        warm_s = [first_sample_s(options.experiment, folder, caches) for _ in range(options.runs)]
        caches["NUMBA_CACHE_DIR"] = str(folder / "none")
        cold_s = first_sample_s(options.experiment, folder, caches)
    kept = judged("cold", [cold_s], options.max_cold_s)
    return int(not (judged("warm", warm_s, options.max_warm_s) and kept))


if __name__ == "__main__":
    sys.exit(main())
