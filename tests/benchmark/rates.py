"""Late ticks, processor time and memory of runs, and of a C program that only sleeps.

    python -m tests.benchmark.rates [--seconds 10] [--pairs 3]

Runs of the simulated rig, recorded, at 5 kHz with one sample per tick, and at 50 kHz in blocks of
50 with the Omega and the staged model. After each, ``wakeup.c`` wakes as often at the same priority
and does nothing, with CPUs kept out of deep sleep as in a run. It prints the share of ticks that
woke late by more than half a period, cores and memory. Exit code 1 if a goal is missed, or a run
ends early or loses a sample.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.machine.syscalls import DMA_LATENCY
from tests.benchmark.wakeup import SOURCE

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
PRIORITY = 80
LATE_AFTER = 0.5
LATE_PERCENT, CORES, RESIDENT_MB = 0.1, 0.2, 300.0


@dataclass(frozen=True)
class Case:
    """A rate and a block with its goals; ``cores`` is for all processes."""

    rate_hz: int
    block: int
    model: str = "omega"
    late_percent: float | None = None
    cores: float | None = None
    resident_mb: float | None = None


CASES = (
    Case(5_000, 1, late_percent=LATE_PERCENT),
    Case(50_000, 50, cores=CORES, resident_mb=RESIDENT_MB),
    Case(50_000, 50, model="staged", cores=CORES, resident_mb=RESIDENT_MB),
)


def ours(case: Case, seconds: float, folder: Path) -> dict[str, Any]:
    """Run hilctl; return what it says of the run."""
    settings = {"sample_rate_hz": case.rate_hz, "block": case.block}
    settings |= {"waveform.duration_s": seconds, "timing.late_after": LATE_AFTER}
    settings |= {"compensator.model": EXPERIMENT.parent / f"models/terfenol_{case.model}.yaml"}
    given = [f"--set={key}={value}" for key, value in settings.items()]
    command = [sys.executable, "-m", "hilctl", "run", str(EXPERIMENT), *given]
    command += ["--json", "--overwrite", "--output", str(folder / "run.mcap")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    if not ran.stdout:
        sys.exit(f"hilctl: {ran.stderr}")
    found: dict[str, Any] = json.loads(ran.stdout)
    return found


@contextmanager
def out_of_deep_sleep() -> Iterator[None]:
    """Keep CPUs awake or nearly so, as far as this user may, for as long as a run does it."""
    with ExitStack() as stack:
        with suppress(OSError):
            wish = stack.enter_context(Path(DMA_LATENCY).open("wb", buffering=0))
            wish.write(bytes(4))
        yield


def sleeper(case: Case, seconds: float, program: Path) -> tuple[float, float]:
    """Let the C program wake as often; return the percentage that is late, and cores."""
    interval_us = round(1e6 * case.block / case.rate_hz)
    loops = round(seconds * case.rate_hz / case.block)
    command = ["chrt", "--fifo", str(PRIORITY)]
    command += [str(program), str(interval_us), str(loops), "1000", "catch_up"]
    with out_of_deep_sleep():
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        ran = subprocess.run(command, capture_output=True, text=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = [line.split() for line in ran.stdout.splitlines() if line[:1].isdigit()]
    beyond = int(ran.stdout.rpartition(":")[2])
    late = beyond + sum(int(n) for us, n in rows if int(us) >= LATE_AFTER * interval_us)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return 100.0 * late / loops, cpu_s / seconds


def measured(case: Case, pairs: int, seconds: float, folder: Path) -> bool:
    """Measure and print a case; return whether its goals are met."""
    late, cores, resident_mb, late_c, cores_c = [], [], [], [], []
    whole = True
    for _ in range(pairs):
        run = ours(case, seconds, folder)
        loop, supervisor = run["processes"]["loop"], run["processes"]["supervisor"]
        late.append(100.0 * run["late_ticks"] * case.block / run["samples"])
        cores.append((loop["cpu_ns"] * 1e-9 / seconds, supervisor["cpu_ns"] * 1e-9 / seconds))
        resident_mb.append([each["resident_bytes"] * 1e-6 for each in (loop, supervisor)])
        whole = whole and run["complete"] and not run["dropped"]
        if not (run["complete"] and not run["dropped"]):
            print(f"  {run['reason']}; {run['dropped']} dropped")
        alone = sleeper(case, seconds, folder / "wakeup")
        late_c.append(alone[0])
        cores_c.append(alone[1])
    loop_cores, supervisor_cores = map(statistics.median, zip(*cores, strict=True))
    memory_mb = [statistics.median(each) for each in zip(*resident_mb, strict=True)]
    print(
        f"{case.rate_hz} Hz, blocks of {case.block}, {case.model}: "
        f"late {text(late)} %, C {text(late_c)} %; "
        f"cores of loop and supervisor {loop_cores:.3f} and {supervisor_cores:.3f}, "
        f"C {statistics.median(cores_c):.3f}; resident {memory_mb[0]:.0f} and {memory_mb[1]:.0f} MB"
    )
    goals = (
        (statistics.median(late), case.late_percent),
        (loop_cores + supervisor_cores, case.cores),
        (max(memory_mb), case.resident_mb),
    )
    return whole and all(goal is None or value <= goal for value, goal in goals)


def text(values: list[float]) -> str:
    """Return median and range of some percentages."""
    return f"{statistics.median(values):.2g} ({min(values):.2g} to {max(values):.2g})"


def main() -> int:
    """Print the figures; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--pairs", type=int, default=3)
    asked = parser.parse_args()
    print(f"goals: late {LATE_PERCENT} % at 5 kHz; {CORES} core and {RESIDENT_MB:g} MB per process "
          f"in blocks of 50; load {os.getloadavg()[0]:.1f}")  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run(["cc", "-O2", "-o", str(folder / "wakeup"), str(SOURCE)], check=True)
        met = [measured(case, asked.pairs, asked.seconds, folder) for case in CASES]
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
