"""Kill and stop a run's processes at random times in each of its phases; the device's log judges.

Run it with ``python -m tests.benchmark.kills``; see README.md beside it.
"""

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from hilctl.base.errors import HilctlError
from hilctl.base.files import RECORDING_MAGIC
from hilctl.recording.reader import read
from hilctl.run.shared.shared_page import PageField, Phase, SharedPage
from tests.benchmark.attacked import (
    LONGEST_S,
    RAMP_A_PER_S,
    RAMP_S,
    START_A,
    WIRES,
    AttackedRun,
    attacked_run,
)
from tests.benchmark.other_reader import verdict

SLOW_WRITE = Path(__file__).with_name("slow_write.c")
OBSERVED_S = 1.0
SAFE_A = 2e-3
ENDED = {Phase.ENDED, Phase.FAILED, Phase.REFUSED}
END_S = 60.0
READABLE_S = 5.0
STAYS = ", does not end"
_TRIPS_AT_UM = (12.0, 20.0)
MODULES = {"loop": b"hilctl.run.loop_process", "guardian": b"hilctl.run.safety.guardian"}
PHASES = (
    *("start", "ramp in", "condition", "run", "set", "away", "trip", "ramp out", "close"),
    "recovery",
)
TARGETS = (
    *("loop", "guardian", "supervisor"),
    *("loop+guardian", "loop+supervisor", "guardian+supervisor"),
    "loop+guardian+supervisor",
)
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}


@dataclass(frozen=True, slots=True)
class Attack:
    """What one attack came to; of several axes, the worst.

    Attributes:
        phase: What the run did when it was hit.
        hit: What was done to which processes.
        lost: Samples put out that are not in the recording, in order.
        beyond_ramp_s: Time until the output stayed at its safe value, from the attack or, if the
            loop was to go on, from the end of the run, less what the safe ramp takes.
        largest_step: Largest step from then on, over what the safe ramp may move meanwhile.
        apart: Largest difference of two outputs from then on, over the one at that time and one
            step; 0 with one axis, or if a device was away.
        readable_s: Time from the end of the loop until the recording was complete.
        reader: What another reader says against the recording; empty if it agrees.
        is_false: Whether "confirmed" was recorded of an output that was not at its safe value.
    """

    phase: str
    hit: str
    lost: int
    beyond_ramp_s: float
    largest_step: float
    apart: float
    readable_s: float
    reader: str
    is_false: bool

    def is_good(self, within_s: float, max_step: float) -> bool:
        """Return whether nothing was lost, the output was safe in time, and the readers agree."""
        step = max(self.largest_step, self.apart)
        safe = self.beyond_ramp_s <= within_s and step <= max_step
        recorded = self.lost == 0 and not self.reader and self.readable_s <= READABLE_S
        return recorded and safe and not self.is_false and not self.hit.endswith(STAYS)


def _children(supervisor: int) -> dict[str, int]:
    """Return loop and guardian of a run by name."""
    found = {}
    with suppress(FileNotFoundError):
        children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
        for child in children:
            words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            found |= {name: int(child) for name, module in MODULES.items() if module in words}
    return found


def _begun(page: SharedPage) -> bool:
    return page.get(PageField.ENDED_AT) > 0


def _in_waveform(page: SharedPage) -> bool:
    return page.get(PageField.ENDED_AT) > page.get(PageField.WAVEFORM_AT) > 0


def _leaving(page: SharedPage) -> bool:
    return page.get(PageField.STOP) != 0


def _closing(page: SharedPage) -> bool:
    return page.get(PageField.PHASE) in {Phase.CLOSING, Phase.ENDED}


def _await(run: AttackedRun, phase: str, chance: random.Random) -> tuple[SharedPage, float]:
    """Bring a run to a phase; return its page, and how long that phase lasts.

    In ``trip`` an interlock of the last device has just tripped.
    """
    page = run.page()
    if phase == "start":
        return page, 0.6
    if phase in {"ramp in", "condition"}:
        run.await_(lambda: _begun(page))
        ramp_s = START_A / RAMP_A_PER_S
        time.sleep(ramp_s if phase == "condition" else 0.0)
        return page, 0.6 if phase == "condition" else ramp_s
    run.await_(lambda: _in_waveform(page))
    if phase == "away":  # it executes what is sent meanwhile when it returns
        os.kill(run.emulators[-1].pid, signal.SIGSTOP)
    if phase == "trip":
        run.await_(lambda: any(e.level == "error" for e in page.look_at_events(0)[0]))
        return page, RAMP_S
    if phase == "set":
        run.hilctl("set", "gain=0.5", "--over", "0.5", stdout=subprocess.DEVNULL).wait(LONGEST_S)
        return page, 0.7
    if phase in {"ramp out", "close"}:
        time.sleep(chance.uniform(0.1, 1.0))
        run.process.send_signal(signal.SIGTERM)
        run.await_(lambda: _leaving(page) if phase == "ramp out" else _closing(page))
        return page, RAMP_S if phase == "ramp out" else 0.1
    return page, 1.0


def attack(
    run: AttackedRun, phase: str, targets: str, actions: list[str], chance: random.Random
) -> tuple[str, int, int | None, float, float]:
    """Hit processes of a run in a phase, each by one of the actions, and let it end.

    Returns:
        What was done, when, when the output was to become safe (None for not at all), up to when
        the loop could put out samples, and how long the recording took to become complete.
    """
    page, lasts_s = _await(run, phase, chance)
    tripped_ns = time.monotonic_ns()
    time.sleep(chance.uniform(0.0, lasts_s))
    processes = {"supervisor": run.process.pid, **_children(run.process.pid)}
    names = ["loop", "supervisor"] if phase == "recovery" else targets.split("+")
    plan = {name: chance.choice(actions) for name in names}
    if phase == "recovery":
        plan = dict.fromkeys(names, "kill")
    chance.shuffle(names)
    hit_ns = time.monotonic_ns()
    for name in names:
        with suppress(ProcessLookupError):
            if name in processes:
                os.kill(processes[name], SIGNALS[plan[name]])
    said = ", ".join(f"{what} {name}" for name, what in sorted(plan.items()))
    if phase == "recovery":
        said += ", " + _hit_recovery(run, chance)
    time.sleep(OBSERVED_S)
    stop_ns = time.monotonic_ns()
    for number in (signal.SIGCONT, signal.SIGTERM):  # a supervisor that was stopped ends its run
        with suppress(ProcessLookupError):
            run.process.send_signal(number)
    _await_loop(run, page, processes.get("loop", 0))
    began_s = time.monotonic()
    if not _completes(run):
        run.recover()
    readable_s = time.monotonic() - began_s
    _await_supervisor(run)
    run.recover()
    os.kill(run.emulators[-1].pid, signal.SIGCONT)
    return_ns = time.monotonic_ns()
    said += _await_end(run, page)
    run.recover()  # of a loop that was stopped until now
    ends = "loop" in plan or plan.get("supervisor") == "kill" or phase in {"ramp out", "close"}
    due_ns = tripped_ns if phase == "trip" else hit_ns if ends else stop_ns
    if phase == "away" or len(plan) == len(processes):  # or until one of them is continued
        due_ns = return_ns
    # Without the start signal the loop has sent nothing, and the output stays as it was.
    driven = page.get(PageField.GO) != 0 and list(plan.values()).count("kill") < len(processes)
    until_ns = hit_ns if "loop" in plan else 1e30
    return said, hit_ns, due_ns if driven else None, until_ns, readable_s


def _hit_recovery(run: AttackedRun, chance: random.Random) -> str:
    """Kill or stop the command that finishes a dead run."""
    next_command = run.hilctl("status", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(chance.uniform(0.1, 1.0))
    what = chance.choice(list(SIGNALS))
    next_command.send_signal(SIGNALS[what])
    if what == "stop":
        time.sleep(0.3)
        next_command.send_signal(signal.SIGCONT)
    next_command.wait(LONGEST_S)
    return f"{what} the next command"


def _await_loop(run: AttackedRun, page: SharedPage, loop: int) -> None:
    """Wait until a loop has ended, for a limited time: it may still try to confirm."""
    deadline = time.monotonic() + END_S
    while time.monotonic() < deadline and page.get(PageField.PHASE) not in ENDED:
        if run.process.poll() is not None:
            _continue(run.processes())
        try:
            if b") Z" in Path(f"/proc/{loop}/stat").read_bytes():
                return
        except (FileNotFoundError, ProcessLookupError):
            return
        time.sleep(0.01)


def _continue(processes: list[int]) -> None:
    for each in processes:
        with suppress(ProcessLookupError):
            os.kill(each, signal.SIGCONT)


def _completes(run: AttackedRun) -> bool:
    """Wait until the recordings have their ends, or their supervisor has ended without."""
    deadline = time.monotonic() + END_S
    while run.process.poll() is None and time.monotonic() < deadline:
        if all(map(_is_complete, run.outputs)):
            return True
        time.sleep(0.01)
    return False


def _is_complete(path: Path) -> bool:
    with suppress(OSError), path.open("rb") as file:
        file.seek(-len(RECORDING_MAGIC), os.SEEK_END)
        return file.read() == RECORDING_MAGIC and file.tell() > len(RECORDING_MAGIC)
    return False


def _await_supervisor(run: AttackedRun) -> None:
    """Wait until the command of the run has ended, for a limited time."""
    with suppress(subprocess.TimeoutExpired):
        run.process.wait(END_S)


def _await_end(run: AttackedRun, page: SharedPage) -> str:
    """Wait until all processes are gone but a guardian that holds the safe value.

    Return STAYS if they are not. The guardian is ended, as a user does. A process that is stopped
    continues once the supervisor has ended.
    """
    deadline = time.monotonic() + END_S
    while left := run.processes():
        ended = run.process.poll() is not None
        _continue(left if ended else [])
        result = page.safe_result()
        if ended and result is not None and result.output == "set":
            with suppress(ProcessLookupError):
                os.kill(page.get(PageField.GUARDIAN_PID), signal.SIGTERM)
        if time.monotonic() > deadline:
            for each in left:
                os.kill(each, signal.SIGKILL)
            return STAYS
        time.sleep(0.02)
    return ""


def judged(run: AttackedRun, phase: str, done: tuple[str, int, int | None, float, float]) -> Attack:
    said, hit_ns, due_ns, until_ns, readable_s = done
    logs, lost, is_false, readers = run.logs(), 0, False, []
    for log, output in zip(logs, run.outputs, strict=True):
        samples = None
        if due_ns is not None or (output.exists() and output.stat().st_size):
            try:
                recording = read(output)
                samples = recording.samples
                confirmed = recording.end.get("output_state") == "confirmed"
                is_false |= confirmed and bool(abs(log.current_a[-1]) > SAFE_A)
                readers.append(verdict(output, samples.command.size))
            except HilctlError as error:
                readers.append(str(error))
        lost += log.lost(samples, until_ns)
    from_ns = hit_ns if due_ns is None else due_ns
    pairs = [] if phase == "away" else itertools.combinations(logs, 2)
    return Attack(
        phase=phase,
        hit=said,
        lost=lost,
        beyond_ramp_s=0.0 if due_ns is None else max(each.beyond_ramp_s(due_ns) for each in logs),
        largest_step=max(each.largest_step(from_ns) for each in logs),
        apart=max((one.apart(other, from_ns) for one, other in pairs), default=0.0),
        readable_s=readable_s,
        reader="; ".join(filter(None, readers)),
        is_false=is_false,
    )


def _slow_disk(folder: Path, stall_s: float) -> dict[str, str]:
    """Return what must stand in the environment of a run whose every write takes ``stall_s``."""
    if not stall_s:
        return {}
    library = folder / "slow_write.so"
    words = ["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(SLOW_WRITE), "-ldl"]
    subprocess.run(words, check=True)
    return {"LD_PRELOAD": str(library), "SLOW_WRITE_S": str(stall_s)}


def print_table(found: list[tuple[str, Attack]]) -> None:
    """Print a line for each phase and each group of processes."""
    head = "runs  lost  to safe beyond ramp  largest step  apart  readable, after  false confirmed"
    print(f"{'attack':<40} {head}")
    for name, group in itertools.groupby(sorted(found, key=lambda each: each[0]), lambda e: e[0]):
        rows = [each for _, each in group]
        readable = sum(not each.reader for each in rows)
        print(
            f"{name:<40} {len(rows):4} {sum(each.lost for each in rows):5}"
            f" {1e3 * max(each.beyond_ramp_s for each in rows):17.0f} ms"
            f" {max(each.largest_step for each in rows):13.2f}"
            f" {max(each.apart for each in rows):6.2f} {readable:4} of {len(rows)}"
            f" {max(each.readable_s for each in rows):5.1f} s"
            f" {sum(each.is_false for each in rows):16}"
        )


def main() -> int:
    """Run it; exit code 1 if a sample is lost, the output safe too late, or a reader disagrees."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=48, help="attacks, over all phases in turn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--wire", choices=WIRES, nargs="+", default=["tcp"], help="one per axis")
    parser.add_argument("--phase", choices=PHASES, help="only this one")
    parser.add_argument("--targets", choices=TARGETS, help="only these")
    parser.add_argument("--action", choices=SIGNALS, help="only this one")
    parser.add_argument("--stall-s", type=float, default=0.0, help="time that a write takes")
    parser.add_argument("--within-ms", type=float, default=200.0, help="to safe beyond the ramp")
    parser.add_argument("--max-step", type=float, default=1.0, help="over the safe ramp's")
    parser.add_argument("--json", action="store_true", help="print a line for each attack")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    kinds = [
        (phase, targets)
        for phase in ([options.phase] if options.phase else PHASES)
        for targets in ([options.targets] if options.targets else TARGETS)
        if phase != "recovery" or targets == "loop+supervisor"
    ]
    chance.shuffle(kinds)
    actions = [options.action] if options.action else list(SIGNALS)
    found: list[tuple[str, Attack]] = []
    with tempfile.TemporaryDirectory(prefix="hilctl-kills-") as name:
        folder = Path(name)
        disk = _slow_disk(folder, options.stall_s)
        for number, (phase, targets) in zip(range(options.count), itertools.cycle(kinds)):
            wires = [WIRES[name] for name in options.wire]
            stroke_um = chance.uniform(*_TRIPS_AT_UM) if phase == "trip" else 120.0
            place = folder / str(number)
            with attacked_run(place, *wires, stroke_um=stroke_um, environment=disk) as run:
                attacked = judged(run, phase, attack(run, phase, targets, actions, chance))
            found.append((f"{phase}: {targets}", attacked))
            if options.json:
                print(json.dumps(asdict(attacked)), flush=True)
            if not attacked.is_good(1e-3 * options.within_ms, options.max_step):
                print(attacked, file=sys.stderr, flush=True)
    if not options.json:
        print_table(found)
    good = (each.is_good(1e-3 * options.within_ms, options.max_step) for _, each in found)
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
