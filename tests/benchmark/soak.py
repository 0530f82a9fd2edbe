"""Long recorded run of the simulated rig: lost samples, late ticks, cores and memory.

Run it with ``python -m tests.benchmark.soak``; see README.md beside it.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from tests.fakes import loop_of

ROOT = Path(__file__).parents[2]
_GROWTH_KIB = 1024
EXPERIMENT = ROOT / "configs" / "terfenol_sine_6a.yaml"


def rss_kib(pid: int) -> int:
    """Return the resident memory of a process, anonymous and mapped."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def watch(run: subprocess.Popen[bytes], path: Path) -> dict[str, list[tuple[float, int]]]:
    """Note the memory of supervisor and loop every second while samples come."""
    seen: dict[str, list[tuple[float, int]]] = {"supervisor": [], "loop": []}
    begun = None
    while run.poll() is None:
        time.sleep(1.0)
        if not path.exists() or path.stat().st_size < 100_000:
            continue
        begun = begun or time.monotonic()
        at = time.monotonic() - begun
        try:
            seen["loop"].append((at, rss_kib(loop_of(run.pid))))
            seen["supervisor"].append((at, rss_kib(run.pid)))
        except (AssertionError, OSError):  # it has ended; what comes now is the report
            return seen
        print(f"\r{at:6.0f} s, {seen['supervisor'][-1][1]} + {seen['loop'][-1][1]} KiB", end="")
    return seen


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate-hz", type=int, default=50_000)
    parser.add_argument("--block", type=int, default=50)
    parser.add_argument("--max-late-percent", type=float, default=0.1, help="late ticks")
    parser.add_argument("--max-cores", type=float, default=0.2, help="loop and supervisor together")
    parser.add_argument("--max-mb", type=float, default=300.0, help="resident memory per process")
    parser.add_argument("--keep", type=Path, help="keep the recording here")
    options = parser.parse_args()
    duration_s = 60.0 * options.minutes
    with tempfile.TemporaryDirectory(prefix="hilctl-soak-") as folder:
        path = options.keep or Path(folder) / "soak.mcap"
        settings = {"waveform.duration_s": duration_s, "sample_rate_hz": options.rate_hz}
        settings |= {"block": options.block, "timing.late_after": 0.5}
        words = ["run", str(EXPERIMENT), "--output", str(path), "--overwrite", "--json"]
        words += [f"--set={key}={value}" for key, value in settings.items()]
        command = [sys.executable, "-m", "hilctl", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as run:
            seen = watch(run, path)
            print()
            assert run.stdout is not None
            result = json.loads(run.stdout.read())
    for name in ("code", "reason", "recorded_samples", "dropped", "late_ticks", "lateness_us"):
        print(f"{name}: {result[name]}")
    for minute in result["lateness_by_minute"]:
        print("  ".join(f"{name} {value:.4g}" for name, value in minute.items()))
    growth_kib = {name: _growth_kib(noted) for name, noted in seen.items()}
    usage = result["processes"]
    cores = {name: each["cpu_ns"] * 1e-9 / duration_s for name, each in usage.items()}
    resident_mb = {name: each["resident_bytes"] * 1e-6 for name, each in usage.items()}
    late_percent = 100.0 * result["late_ticks"] * options.block / result["samples"]
    print(f"late {late_percent:.3g} %; cores {cores}; resident MB {resident_mb}")
    print(f"memory growth after the first minute: {growth_kib} KiB")
    met = (
        result["code"] == "completed",
        result["dropped"] == 0,
        late_percent <= options.max_late_percent,
        sum(cores.values()) <= options.max_cores,
        max(resident_mb.values()) <= options.max_mb,
        all(each < _GROWTH_KIB for each in growth_kib.values()),
    )
    return 0 if all(met) else 1


def _growth_kib(noted: list[tuple[float, int]]) -> float:
    """Return the largest increase of the median of a minute over that of the second minute.

    Medians, because the recorder's chunk fills and empties by some MB every two seconds.
    """
    minutes: dict[int, list[int]] = {}
    for at, kib in noted:
        minutes.setdefault(int(at // 60), []).append(kib)
    medians = [median(minutes[minute]) for minute in sorted(minutes) if minute]
    return max(medians) - medians[0] if medians else 0.0


if __name__ == "__main__":
    sys.exit(main())
