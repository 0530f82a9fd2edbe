"""Compare hilctl's wake-up lateness with cyclictest's: same priority, same rate, same minute.

Run it with ``python -m tests.benchmark.wakeup``; see README.md beside it. It needs cyclictest
(Debian: rt-tests). hilctl's side is measured through the loop's own pacer, clock and set-up.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from hilctl.machine.rt_setup import Realtime
from hilctl.machine.timer_latency import Latency, measure

SOURCE = Path(__file__).with_suffix(".c")
LONGEST_US = 60_000
QUANTILE = 99.9
BAR = 30
SETTLED_S = 2.5
"""Time after which either side has started, and only measures."""
COUNTED = {"minor faults": 9, "major faults": 11}
"""Fields of ``/proc/PID/task/TID/stat``, from 0."""


class Watch:
    """What a process meets while it measures, by the kernel's count: all threads together."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget what was seen: a process starts now."""
        self._began_s = time.monotonic()
        self._first: dict[str, Counter[str]] = {}
        self._last: dict[str, Counter[str]] = {}

    def look(self, process: int) -> None:
        """Look at a process that may be gone."""
        with suppress(OSError):
            for task in Path(f"/proc/{process}/task").iterdir():
                self._last[task.name] = counts = _counts(task)
                if time.monotonic() - self._began_s < SETTLED_S:
                    self._first[task.name] = counts

    def text(self) -> str:
        """Return what came since it had settled, for people."""
        names = [*COUNTED, "involuntary switches", "migrations"]
        taken: Counter[str] = Counter()
        for task, first in self._first.items():
            taken.update({name: self._last[task][name] - first[name] for name in names})
        return ", ".join(f"{taken[name]} {name}" for name in names)


def _counts(task: Path) -> Counter[str]:
    fields = (task / "stat").read_text().rpartition(")")[2].split()
    found = Counter({name: int(fields[number - 2]) for name, number in COUNTED.items()})
    lines = (task / "status").read_text().splitlines()
    lines += (task / "sched").read_text().splitlines() if (task / "sched").exists() else []
    for line in lines:
        if line.startswith("nonvoluntary_ctxt_switches"):
            found["involuntary switches"] = int(line.split()[-1])
        elif line.startswith("se.nr_migrations"):
            found["migrations"] = int(line.split()[-1])
    return found


def _children() -> list[int]:
    tasks = Path("/proc/self/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def theirs_us(options: argparse.Namespace, allowed: set[str], watch: Watch) -> np.ndarray:
    """Run cyclictest as hilctl was allowed to run; return each wake-up's lateness in us.

    Without SCHED_FIFO cyclictest won't start; then the same measurement in C takes its place.
    """
    interval_us, loops = round(1e6 / options.rate), round(options.rate * options.seconds)
    if "fifo" in allowed:
        command = [options.cyclictest, "--threads=1", "--quiet", f"--priority={options.priority}"]
        command += [f"--interval={interval_us}", f"--loops={loops}", f"--histogram={LONGEST_US}"]
        command += ["--mlockall"] if "memory" in allowed else []
        command += [] if "dma_latency" in allowed else ["--laptop"]
    else:
        command = [options.plain, str(interval_us), str(loops), str(LONGEST_US)]
    with tempfile.TemporaryFile("w+") as output:
        ran = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        while ran.poll() is None:
            watch.look(ran.pid)
            time.sleep(0.1)
        output.seek(0)
        lines = output.read().splitlines()
    if ran.returncode:
        sys.exit(f"{command[0]} failed: {' '.join(lines)}")
    rows = [line.split() for line in lines if line[:1].isdigit()]
    late_us, counts = np.array(rows, dtype=np.int64).T
    overflows = next(line for line in lines if "Histogram Overflows" in line)
    beyond = np.full(int(overflows.split(":")[1]), LONGEST_US)
    return np.concatenate([np.repeat(late_us, counts), beyond])


def other_side(folder: Path, allowed: set[str]) -> dict[str, str]:
    """Return what hilctl is compared with: cyclictest, or a program built in ``folder``."""
    if "fifo" in allowed:
        cyclictest = shutil.which("cyclictest")
        if cyclictest is None:
            sys.exit("no cyclictest: apt-get install rt-tests")
        return {"name": "cyclictest", "cyclictest": cyclictest}
    print("SCHED_FIFO is refused here: both run without it, and wakeup.c instead of cyclictest")
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        sys.exit("no C compiler: install gcc")
    program = folder / "wakeup"
    subprocess.run([compiler, "-O2", "-o", str(program), str(SOURCE)], check=True)
    return {"name": "wakeup.c", "plain": str(program)}


def hilctl_us(options: argparse.Namespace, allowed: set[str], watch: Watch) -> np.ndarray:
    """Measure hilctl; return each wake-up's lateness in whole us, cut as cyclictest's is.

    Both leave out the ticks that a stall has made late: it counts once.
    """

    def look(_elapsed_s: float) -> None:
        for process in _children():
            watch.look(process)

    settings = Realtime(priority=options.priority)
    latency = measure(options.rate, options.seconds, settings, look, policy="skip")
    assert done(latency) == allowed, "what is allowed has changed"
    return np.minimum(latency.late_ns // 1000, LONGEST_US)


def done(latency: Latency) -> set[str]:
    """Return the steps of the set-up that were not refused."""
    return {step.name for step in latency.steps if step.outcome == "done"}


def figures(late_us: np.ndarray) -> str:
    """Return p50, p99, p99.9 and max as text."""
    p50, p99, p999, top = np.percentile(late_us, [50, 99, QUANTILE, 100])
    return f"p50 {p50:5.0f}  p99 {p99:6.0f}  p99.9 {p999:6.0f}  max {top:6.0f}"


def print_histograms(name: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Print both histograms side by side; bars grow with the logarithm of the count."""
    edges = np.concatenate([[0], 2 ** np.arange(0, 17)])
    counts = [np.histogram(late_us, edges)[0] for late_us in (ours, theirs)]
    longest = np.log1p(max(count.max() for count in counts))
    print(f"\n{'us':>13}  {'hilctl':<{BAR + 9}}{name}")
    for k in range(edges.size - 1):
        if counts[0][k] + counts[1][k] == 0:
            continue
        bars = [f"{c[k]:>7} {'#' * round(BAR * np.log1p(c[k]) / longest):<{BAR}}" for c in counts]
        print(f"{edges[k]:>5} - {edges[k + 1]:>5}  {' '.join(bars).rstrip()}")


def compare(options: argparse.Namespace, folder: Path) -> float:
    """Run all pairs and print them; return the ratio of p99.9 over all of them.

    A stall of the machine, which hits one side of a pair, is most of that pair's tail: ratios of
    single pairs go from 0.1 to 20 where those of all wake-ups agree.
    """
    first = measure(options.rate, options.seconds / 10, Realtime(priority=options.priority))
    for step in first.steps:
        print(f"{step.name:>13}  {step.outcome}: {step.detail}")
    vars(options).update(other_side(folder, done(first)))
    sides, late_us, ratios = (hilctl_us, theirs_us), ([], []), []
    for pair in range(options.pairs):
        watches = Watch(), Watch()
        for side in ((0, 1), (1, 0))[pair % 2]:
            watches[side].restart()
            late_us[side].append(sides[side](options, done(first), watches[side]))
        mine, other = late_us[0][-1], late_us[1][-1]
        ratios.append(float(np.percentile(mine, QUANTILE) / np.percentile(other, QUANTILE)))
        print(f"pair {pair + 1}  hilctl {figures(mine)}  |  {options.name} {figures(other)}  us  "
              f"ratio of p99.9 {ratios[-1]:.2f}")  # fmt: skip
        for name, watch in zip(("hilctl", options.name), watches, strict=True):
            print(f"{name:>13}  {watch.text()}", flush=True)
    all_us = [np.concatenate(each) for each in late_us]
    print_histograms(options.name, *all_us)
    print(f"\nmedian of the pairs' ratios of p99.9: {np.median(ratios):.2f}")
    p999_us = [float(np.percentile(each, QUANTILE)) for each in all_us]
    print(f"p99.9 of all pairs: hilctl {p999_us[0]:.0f}, {options.name} {p999_us[1]:.0f} us")
    return p999_us[0] / p999_us[1]


def main() -> int:
    """Run the benchmark; the exit code is 1 where the ratio is above ``--max-ratio``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--pairs", type=int, default=25)
    parser.add_argument("--seconds", type=float, default=6.0, help="length of each run")
    parser.add_argument("--rate", type=float, default=1000.0, help="ticks a second")
    parser.add_argument("--priority", type=int, default=80)
    parser.add_argument("--max-ratio", type=float, default=1.2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        ratio = compare(options, Path(name))
    print(f"ratio of these: {ratio:.2f}, at most {options.max_ratio:g}")
    return int(ratio > options.max_ratio)


if __name__ == "__main__":
    sys.exit(main())
