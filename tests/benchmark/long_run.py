"""A simulated run of hours: faster than real time, with flat memory.

    python -m tests.benchmark.long_run [--seconds 28800] [--folder FOLDER] [--set KEY=VALUE]

The run is that of ``configs/terfenol_sine_6a.yaml`` at 50 kHz, in a process of its own, whose
memory is looked at every second. Eight hours of it are 41 GB in the folder, removed at the end.
Exit code 1 where it is slower than real time, loses a sample, or takes more memory in its second
half than in its first.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hilctl.run.start import checked_experiment
from hilctl.run.unpaced import run_unpaced
from tests.benchmark.soak import rss_kib

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
FLAT = 1.05


def run(settings: list[str], path: Path) -> dict[str, Any]:
    """Run it in this process; return what it took and what came of it."""
    began = time.perf_counter()
    checked = checked_experiment(EXPERIMENT, settings)
    checked_s = time.perf_counter() - began
    result = run_unpaced(checked, path)
    return {
        "check_s": checked_s,
        "run_s": time.perf_counter() - began - checked_s,
        "cpu_s": time.process_time(),
        "code": result.code,
        "samples": result.samples,
        "missing": result.missing,
        "bytes": path.stat().st_size,
    }


def watched(arguments: list[str]) -> tuple[dict[str, Any], list[int]]:
    """Run it in another process; return what that says, and its memory in KiB second by second."""
    command = [sys.executable, "-m", "tests.benchmark.long_run", *arguments]
    seen: list[int] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        while child.poll() is None:
            time.sleep(1.0)
            seen.append(rss_kib(child.pid))
        assert child.stdout is not None
        text = child.stdout.read()
    if child.returncode != 0:
        raise SystemExit(f"the run ended with exit code {child.returncode}")
    found: dict[str, Any] = json.loads(text)
    return found, [kib for kib in seen if kib]


def main() -> int:
    """Run it, watch it, and judge it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=28_800.0)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    settings = [f"waveform.duration_s={given.seconds}", *given.settings]
    if given.inside is not None:
        print(json.dumps(run(settings, given.inside)))
        return 0
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        words = ["--inside", str(Path(folder) / "run.mcap"), "--seconds", str(given.seconds)]
        words += [word for each in given.settings for word in ("--set", each)]
        found, seen = watched(words)
    begun = seen[len(seen) // 10 :]  # it grows to what a batch needs
    early, late = max(begun[: len(begun) // 2]), max(begun[len(begun) // 2 :])
    times = given.seconds / found["run_s"]
    print(f"check     {found['check_s']:.2f} s")
    print(f"run       {found['run_s']:.1f} s, {times:.1f} times real time")
    print(f"samples   {found['samples']}, {found['missing']} missing, {found['code']}")
    print(f"recording {found['bytes'] / 1e9:.2f} GB, CPU {found['cpu_s']:.0f} s")
    print(
        f"memory    {early / 1024:.0f} MiB at most in the first half, {late / 1024:.0f} in the"
        f" second: {late / early:.3f}"
    )
    well = found["code"] == "completed" and found["missing"] == 0
    return 0 if well and times > 1.0 and late <= FLAT * early else 1


if __name__ == "__main__":
    sys.exit(main())
