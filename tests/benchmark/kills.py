"""Kill and stop a run's processes at random times, and judge by the device's own log of writes.

Run it with ``python -m tests.benchmark.kills``; see README.md beside it.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hilctl.recording.reader import read
from tests.benchmark.kill_wires import WIRES, AttackedWire, DeviceLog
from tests.benchmark.other_reader import NOT_INSTALLED, verdict
from tests.benchmark.wire_runs import make_real_time

SLOW_WRITE = Path(__file__).with_name("slow_write.c")
OBSERVED_S = 1.0
LONGEST_S = 120.0
RAMP_S = 0.1
EXPERIMENT: dict[str, Any] = {
    "name": "kill",
    "waveform": {
        "kind": "sine",
        "unit": "A",
        "amplitude": 4.0,
        "frequency_hz": 2.0,
        "duration_s": 600.0,
        "soft_start_s": 0.1,
    },
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": RAMP_S},
    "timing": {"on_misses": "warn"},  # a busy machine must not be quicker than the attack
    "recording": {"ring_s": 60.0, "flush_s": 0.5},
}
ROLES = {"loop": b"hilctl.run.loop_process", "guardian": b"hilctl.run.guardian"}
TARGETS = ("loop", "supervisor", "guardian", "loop+supervisor", "loop+guardian")
TARGETS += ("supervisor+guardian",)
ATTACKS = tuple(f"{action}:{target}" for target in TARGETS for action in ("kill", "stop"))
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP, "term": signal.SIGTERM}
LATE, LATE_FROM = 400, 60
"""How many answers are late where a run is ended by SIGTERM, and the first that is."""


@dataclass
class Attack:
    """What one attack came to.

    Attributes:
        attack: ``kill`` or ``stop``, and the processes that it hit.
        after_s: Time from the first writes to the attack.
        safe_ms: Longest time from the attack on that the output stood at another value than the
            safe one with no new write: nobody had it under control. Where a device plays from a
            FIFO and the loop was hit, and after SIGTERM, time until the output was safe. Infinite
            where it stayed.
        allowed_ms: What of that the ramp and late answers may take.
        written: Samples that the device put out.
        recorded: Samples in the recording.
        lost: Samples put out that are not in the recording, in order.
        reason: What the recording says of the end.
        other_reader: Where another program's reading of the recording differs; empty where not.
    """

    attack: str
    after_s: float
    safe_ms: float
    allowed_ms: float
    written: int
    recorded: int
    lost: int
    reason: str
    other_reader: str

    def is_good(self, within_ms: float) -> bool:
        """Return whether nothing was lost, the output was safe in time, and all readers agree."""
        agree = self.other_reader in {"", NOT_INSTALLED}
        return self.lost == 0 and self.safe_ms <= within_ms + self.allowed_ms and agree


class AttackedRuns:
    """Runs of one experiment, each on a device emulated anew."""

    def __init__(self, folder: Path, options: argparse.Namespace) -> None:
        self._folder = folder
        self._wire: AttackedWire = WIRES[options.wire]
        self._profile = self._wire.profile_in(folder)
        self._random = random.Random(options.seed)
        self._environment = {**os.environ, "HILCTL_RUNS": str(folder / "runs")}
        self._disk = _slow_disk(folder, options.stall_s) if options.stall_s else {}

    def _hilctl(
        self, words: list[str], environment: dict[str, str] | None = None, **options: Any
    ) -> subprocess.Popen[Any]:
        command = [sys.executable, "-m", "hilctl", *words]
        given = {**self._environment, **(environment or {})}
        return subprocess.Popen(command, env=given, **options)

    @contextmanager
    def _emulated(self, log: Path, faults: list[str]) -> Iterator[str]:
        """Emulate the device in a process; yield its address."""
        words = ["emulate", self._profile, "--log", str(log), *self._wire.words, *faults]
        emulator = self._hilctl(words, stdout=subprocess.PIPE, text=True)
        make_real_time(emulator.pid)  # a busy machine slows no real device
        try:
            yield emulator.stdout.readline().split()[-1]
        finally:
            emulator.terminate()
            emulator.wait()

    def attack(self, attack: str, number: int) -> Attack:
        """Run, attack at a random time, wait until all is over, and judge."""
        name = f"{attack.replace(':', '-')}-{number}"
        log, experiment = self._folder / f"{name}.jsonl", self._folder / f"{name}.yaml"
        late = attack.startswith("term")
        with self._emulated(log, self._late() if late else []) as address:
            changes = {
                "sample_rate_hz": self._wire.rate_hz,
                "block": self._wire.block,
                "device": self._wire.section(self._profile, address),
            }
            text = {**EXPERIMENT, **changes}
            if late:  # a late answer is no hang here
                text["timing"] = {**EXPERIMENT["timing"], "hang_s": 2.0 * self._wire.latest_s}
            experiment.write_text(yaml.safe_dump(text), encoding="utf-8")
            return self._attacked(attack, experiment, log)

    def _late(self) -> list[str]:
        """Return what makes answers late, from some time after the start on."""
        latest_s, every = self._wire.latest_s, self._wire.late_every
        times_s = [self._random.uniform(0.05, latest_s) for _ in range(LATE)]
        faults = [f"delay:{each:.3f}@{LATE_FROM + k * every}" for k, each in enumerate(times_s)]
        return [word for fault in faults for word in ("--fault", fault)]

    def _attacked(self, attack: str, experiment: Path, log: Path) -> Attack:
        action, _, names = attack.partition(":")
        output = experiment.with_suffix(".mcap")
        words = ["run", str(experiment), "--output", str(output), "--json"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        run = self._hilctl(words, self._disk, **quiet)
        while np.count_nonzero(DeviceLog.read(log).current_a) < 10:
            assert run.poll() is None, f"the run ended by itself: {read(output).end}"
            time.sleep(0.02)
        processes = {"supervisor": run.pid, **_children(run.pid)}
        after_s = self._random.uniform(0.05, 1.5)
        time.sleep(after_s)
        hit = [processes[name] for name in names.split("+")]
        self._random.shuffle(hit)
        hit_ns = time.monotonic_ns()
        for process in hit:
            os.kill(process, SIGNALS[action])
        time.sleep(OBSERVED_S)
        # A supervisor that was stopped is to close its recording; a run that goes on is to end.
        for number in (signal.SIGCONT, signal.SIGTERM):
            with suppress(ProcessLookupError):
                run.send_signal(number)
        run.wait(LONGEST_S)
        _await_end([*processes.values()])
        self._hilctl(["status"], **quiet).wait()  # the next command of any kind recovers
        return self._judge(attack, after_s, hit_ns, DeviceLog.read(log), output)

    def _judge(
        self, attack: str, after_s: float, hit_ns: int, log: DeviceLog, path: Path
    ) -> Attack:
        recording = read(path)
        # Values of a FIFO go on without anybody: where the loop was hit, that is no control. And a
        # ramp that is asked for takes its own time, beside that of the answers it waits for.
        ramp = attack.startswith("term")
        alone = ramp or (self._wire.streams and "loop" in attack)
        allowed_ms = 1e3 * (RAMP_S + 2.0 * self._wire.latest_s) if ramp else 0.0
        return Attack(
            attack=attack,
            after_s=after_s,
            safe_ms=log.safe_after_ms(hit_ns) if alone else log.uncontrolled_ms(hit_ns),
            allowed_ms=allowed_ms,
            written=int(log.ends.max()) if self._wire.streams else log.times_ns.size,
            recorded=recording.samples.command.size,
            lost=log.lost(recording.samples),
            reason=recording.end.get("reason", "none"),
            other_reader=verdict(
                path, None if self._wire.streams else recording.samples.command.size
            ),
        )


def _children(supervisor: int) -> dict[str, int]:
    """Return loop and guardian of a run by name."""
    children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
    found = {}
    for child in children:
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        found |= {name: int(child) for name, module in ROLES.items() if module in words}
    return found


def _await_end(processes: list[int]) -> None:
    """Wait until all processes are gone; a guardian that was stopped beside nobody never is."""
    deadline = time.monotonic() + LONGEST_S
    while any(Path(f"/proc/{each}").exists() for each in processes):
        assert time.monotonic() < deadline
        for each in processes:
            if Path(f"/proc/{each}").exists():
                os.kill(each, signal.SIGCONT)
        time.sleep(0.02)


def _slow_disk(folder: Path, stall_s: float) -> dict[str, str]:
    """Return what must stand in the environment of a run whose every write takes ``stall_s``."""
    library = folder / "slow_write.so"
    words = ["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(SLOW_WRITE), "-ldl"]
    subprocess.run(words, check=True)
    return {"LD_PRELOAD": str(library), "SLOW_WRITE_S": str(stall_s)}


def main() -> int:
    """Run it; exit code 1 where a write was lost, safety came late, or readers differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="attacks of each kind")
    parser.add_argument(
        "--attacks",
        nargs="+",
        default=ATTACKS,
        metavar="kill:loop+guardian",
        help="also stop:... and term:supervisor, beside a device that is late",
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--wire", choices=WIRES, default="modbus")
    parser.add_argument("--stall-s", type=float, default=0.0, help="time that a write takes")
    parser.add_argument("--within-ms", type=float, default=200.0)
    parser.add_argument("--json", action="store_true", help="print every attack as JSON")
    options = parser.parse_args()
    found: list[Attack] = []
    with tempfile.TemporaryDirectory(prefix="hilctl-kills-") as folder:
        runs = AttackedRuns(Path(folder), options)
        for attack in options.attacks:
            for number in range(options.count):
                found.append(runs.attack(attack, number))
                if not options.json:
                    print(found[-1], flush=True)
    if options.json:
        print(json.dumps([asdict(each) for each in found], indent=2))
    else:
        _print_summary(options.attacks, found)
    return 0 if all(each.is_good(options.within_ms) for each in found) else 1


def _print_summary(attacks: list[str], found: list[Attack]) -> None:
    for attack in attacks:
        chosen = [each for each in found if each.attack == attack]
        times = np.array([each.safe_ms for each in chosen])
        print(
            f"{attack}: {times.size} times, {np.median(times):.0f} ms without control median, "
            f"{times.max():.0f} ms worst; {sum(each.lost for each in chosen)} writes lost of "
            f"{sum(each.written for each in chosen)}; @mcap/core {_agreement(chosen)}"
        )


def _agreement(found: list[Attack]) -> str:
    said = {each.other_reader for each in found}
    return "agrees" if said == {""} else " and ".join(sorted(said - {""}))


if __name__ == "__main__":
    sys.exit(main())
