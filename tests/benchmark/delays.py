"""One late request, or a link that is down: does a run say that an output is safe which is not?

Run it with ``python -m tests.benchmark.delays``; see README.md beside it.
"""

import argparse
import itertools
import math
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.benchmark.attacked import RAMP_S, WIRES, AttackedRun, attacked_run
from tests.fakes import loop_of

TIMEOUT_S = 0.5
QUIET_S = 0.05
RETRY_S = 2.0
FIRST, LAST = 10, 200
"""Writes before the one that is late: from the ramp before the waveform to the waveform."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What one trial came to.

    Attributes:
        wrong: Whether it was not at its safe value, then or later.
        late_s: How long after the link's return the output became safe; 0 if it was not down.
    """

    name: str
    what: str
    said_safe: bool
    wrong: bool
    late_s: float

    @property
    def is_good(self) -> bool:
        """Return whether nothing wrong was said, and the output safe soon after the return."""
        return not (self.said_safe and self.wrong) and self.late_s <= RETRY_S + RAMP_S


def one_late_request(folder: Path, wire: str, chance: random.Random) -> Trial:
    """Delay one request while others are carried out; kill the loop meanwhile, or let it time out.

    The device carries the late request out after all others.
    """
    delay_s = math.exp(chance.uniform(math.log(0.1), math.log(10.0)))
    at, kill = chance.randint(FIRST, LAST), chance.random() < 0.5
    what = f"{delay_s:.2f} s at request {at}, loop {'killed' if kill else 'times out'}"
    faults = (f"late:{delay_s:.3f}@{at}",)
    with attacked_run(folder, WIRES[wire], timeout_s=TIMEOUT_S, faults=faults) as run:
        writes, changed_s = 0, math.inf
        # Until the late request, or what follows from it, keeps the device waiting.
        while run.process.poll() is None and time.monotonic() - changed_s < QUIET_S:
            if (size := run.logs()[0].times_ns.size) != writes:
                writes, changed_s = size, time.monotonic() if size >= at // 3 else math.inf
            time.sleep(0.002)
        if kill and run.process.poll() is None:
            time.sleep(chance.uniform(0.0, 0.3))
            with suppress(AssertionError, ProcessLookupError):  # the run has ended it already
                os.kill(loop_of(run.process.pid), signal.SIGKILL)
        time.sleep(TIMEOUT_S)
        # It goes on if the request was not late enough, or the last before the loop was killed.
        run.process.send_signal(signal.SIGTERM)
        said_safe, ended_ns = _said_safe(run)
        time.sleep(delay_s + 0.5)
        log = run.logs()[0]
        later = log.unsafe()[log.times_ns >= ended_ns].any()
        wrong = bool(later) or abs(log.at(ended_ns)) > 1e-2
    return Trial(f"{wire}: late", what, said_safe, wrong, 0.0)


def link_down(folder: Path, wire: str, chance: random.Random, longest_s: float) -> Trial:
    """Kill the loop, with a device that answers nothing for a while; what it was sent waits."""
    down_s = math.exp(chance.uniform(0.0, math.log(longest_s)))
    with attacked_run(folder, WIRES[wire], timeout_s=TIMEOUT_S) as run:
        page = run.page()
        run.await_(lambda: run.logs()[0].times_ns.size >= LAST)
        del page
        time.sleep(chance.uniform(0.0, 1.0))
        run.emulators[0].send_signal(signal.SIGSTOP)
        os.kill(loop_of(run.process.pid), signal.SIGKILL)
        time.sleep(down_s)
        returned_ns = time.monotonic_ns()
        run.emulators[0].send_signal(signal.SIGCONT)
        said_safe, ended_ns = _said_safe(run)
        time.sleep(max(0.0, RETRY_S + RAMP_S - 1e-9 * (time.monotonic_ns() - returned_ns)))
        log = run.logs()[0]
        wrong = bool(log.unsafe()[log.times_ns >= ended_ns].any())
        late_s = log.beyond_ramp_s(returned_ns)
    return Trial(f"{wire}: down", f"{down_s:.1f} s", said_safe, wrong, late_s)


def _said_safe(run: AttackedRun) -> tuple[bool, int]:
    """Wait for the end of a run; return what it said of the output, and when it was over."""
    said = run.said()
    ended_ns = time.monotonic_ns()
    return '"output_safe": true' in said, ended_ns


def print_table(found: list[Trial]) -> None:
    print(f"{'trial':<16} runs  said safe  wrongly  latest after the return")
    for name, group in itertools.groupby(sorted(found, key=lambda e: e.name), lambda e: e.name):
        rows = list(group)
        said = sum(each.said_safe for each in rows)
        wrongly = sum(each.said_safe and each.wrong for each in rows)
        latest_s = max(each.late_s for each in rows)
        print(f"{name:<16} {len(rows):4} {said:10} {wrongly:8} {latest_s:22.2f} s")


def main() -> int:
    """Run it; exit code 1 if an output was called safe and was not, or became safe too late."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="trials, over all wires in turn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--wire", choices=WIRES, help="only this one")
    parser.add_argument("--kind", choices=("late", "down"), help="only this one")
    parser.add_argument("--longest-s", type=float, default=60.0, help="longest that a link is down")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    kinds = [
        (wire, kind)
        for kind in ([options.kind] if options.kind else ("late", "down"))
        for wire in ([options.wire] if options.wire else WIRES)
    ]
    found: list[Trial] = []
    with tempfile.TemporaryDirectory(prefix="hilctl-delays-") as name:
        for number, (wire, kind) in zip(range(options.count), itertools.cycle(kinds), strict=False):
            folder = Path(name) / str(number)
            if kind == "late":
                found.append(one_late_request(folder, wire, chance))
            else:
                found.append(link_down(folder, wire, chance, options.longest_s))
            if not found[-1].is_good:
                print(found[-1], file=sys.stderr, flush=True)
    print_table(found)
    return 0 if all(each.is_good for each in found) else 1


if __name__ == "__main__":
    sys.exit(main())
