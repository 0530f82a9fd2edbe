"""A long run at 50 kHz with recording: nothing dropped, memory flat, lateness by the minute.

Run it with ``python -m tests.benchmark.soak``; see README.md beside it. It takes half an hour.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[2]
EXPERIMENT = ROOT / "configs" / "terfenol_sine_6a.yaml"


def rss_kib(pid: int) -> int:
    """Return the resident memory of a process, anonymous and mapped."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def loop_of(pid: int) -> int | None:
    """Return a run's loop process; None where it has ended."""
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        if b"hilctl.run.loop_process" in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    return None


def watch(run: subprocess.Popen[bytes], path: Path) -> dict[str, list[tuple[float, int]]]:
    """Note the memory of supervisor and loop every second while samples come."""
    seen: dict[str, list[tuple[float, int]]] = {"supervisor": [], "loop": []}
    begun = None
    while run.poll() is None:
        time.sleep(1.0)
        if not path.exists() or path.stat().st_size < 100_000:
            continue
        begun = begun or time.monotonic()
        loop = loop_of(run.pid)
        if loop is None:  # it has ended; what comes now is the report
            return seen
        at = time.monotonic() - begun
        try:
            seen["supervisor"].append((at, rss_kib(run.pid)))
            seen["loop"].append((at, rss_kib(loop)))
        except OSError:
            return seen
        print(f"\r{at:6.0f} s, {seen['supervisor'][-1][1]} + {seen['loop'][-1][1]} KiB", end="")
    return seen


def main() -> int:
    """Run it; exit code 1 where a sample is missing or memory grew by 1 MiB or more."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--keep", type=Path, help="keep the recording here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hilctl-soak-") as folder:
        path = options.keep or Path(folder) / "soak.mcap"
        words = ["run", str(EXPERIMENT), "--output", str(path), "--overwrite", "--json"]
        words += ["--set", f"waveform.duration_s={60.0 * options.minutes}"]
        command = [sys.executable, "-m", "hilctl", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as run:
            seen = watch(run, path)
            print()
            assert run.stdout is not None
            result = json.loads(run.stdout.read())
        growth = {who: _growth_kib(noted) for who, noted in seen.items()}
    for name in ("code", "reason", "recorded_samples", "dropped", "late_ticks", "lateness_us"):
        print(f"{name}: {result[name]}")
    for minute in result["lateness_by_minute"]:
        print("  ".join(f"{name} {value:.4g}" for name, value in minute.items()))
    print(f"growth of memory after the first minute: {growth} KiB")
    ok = result["code"] == "completed" and result["dropped"] == 0
    return 0 if ok and all(each < 1024 for each in growth.values()) else 1


def _growth_kib(noted: list[tuple[float, int]]) -> float:
    """Return by how much the median of a minute rose above that of the second minute.

    Medians, because the recorder's chunk fills and empties by some MB every two seconds.
    """
    minutes: dict[int, list[int]] = {}
    for at, kib in noted:
        minutes.setdefault(int(at // 60), []).append(kib)
    medians = [median(minutes[minute]) for minute in sorted(minutes) if minute]
    return max(medians) - medians[0] if medians else 0.0


if __name__ == "__main__":
    sys.exit(main())
