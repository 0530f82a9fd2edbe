"""Kill and stop a run's processes at random times, and judge by the device's own log of writes.

Run it with ``python tests/benchmark/kills.py``; see README.md beside it. The device is a plain
Modbus TCP server without a watchdog: whatever is last written stays on the output.
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
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from other_reader import NOT_INSTALLED, verdict

from hilctl.base.samples import Flag
from hilctl.recording.reader import read

SLOW_WRITE = Path(__file__).with_name("slow_write.c")
OBSERVED_S = 1.0
LONGEST_S = 120.0
RAMP_S = 0.1
GAIN_A_PER_V = 1.0
PROFILE = """\
vendor: nobody
model: a server with float32 registers and no watchdog
source: [tests/benchmark/kills.py]
verified: "yes"
link: {kind: tcp}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 100, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  IN: {address: 200, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""
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


@dataclass
class Attack:
    """What one attack came to.

    Attributes:
        attack: ``kill`` or ``stop``, and the processes that it hit.
        after_s: Time from the first writes to the attack.
        safe_ms: Longest time from the attack on that the output stood at another value than the
            safe one with no new write: nobody had it under control. Infinite where it stayed.
        written: Writes that the device saw.
        recorded: Samples in the recording.
        lost: Writes whose command is not in the recording, in order.
        reason: What the recording says of the end.
        other_reader: Where another program's reading of the recording differs; empty where not.
    """

    attack: str
    after_s: float
    safe_ms: float
    written: int
    recorded: int
    lost: int
    reason: str
    other_reader: str

    def is_good(self, within_ms: float) -> bool:
        """Return whether nothing was lost, the output was safe in time, and all readers agree."""
        agree = self.other_reader in {"", NOT_INSTALLED}
        return self.lost == 0 and self.safe_ms <= within_ms and agree


class AttackedRuns:
    """An emulated device and experiments that use it."""

    def __init__(self, folder: Path, seed: int, rate_hz: float, stall_s: float) -> None:
        self._folder = folder
        self._random = random.Random(seed)
        self._environment = {**os.environ, "HILCTL_RUNS": str(folder / "runs")}
        self._disk = _slow_disk(folder, stall_s) if stall_s else {}
        profile = folder / "profile.yaml"
        profile.write_text(PROFILE, encoding="utf-8")
        self._log = folder / "writes.jsonl"
        words = ["emulate", str(profile), "--log", str(self._log)]
        self._emulator = self._hilctl(words, stdout=subprocess.PIPE, text=True)
        host, _, port = self._emulator.stdout.readline().split()[-1].rpartition(":")
        device = {
            "kind": "modbus_dac",
            "profile": str(profile),
            "host": host,
            "tcp_port": int(port),
            "output": "OUT",
            "input": "IN",
            "timeout_s": 1.0,
            "amplifier": {"gain_a_per_v": GAIN_A_PER_V},
            "sensor": {"um_per_v": 12.5},
            "watchdog": "none",
        }
        changes = {"sample_rate_hz": rate_hz, "device": device}
        self._experiment = folder / "experiment.yaml"
        self._experiment.write_text(yaml.safe_dump({**EXPERIMENT, **changes}))

    def close(self) -> None:
        """Stop the emulator."""
        self._emulator.terminate()
        self._emulator.wait()

    def _hilctl(
        self, words: list[str], environment: dict[str, str] | None = None, **options: Any
    ) -> subprocess.Popen[Any]:
        command = [sys.executable, "-m", "hilctl.cli", *words]
        given = {**self._environment, **(environment or {})}
        return subprocess.Popen(command, env=given, **options)

    def _writes(self, skip: int) -> list[dict[str, Any]]:
        lines = self._log.read_bytes()[skip:].split(b"\n")[:-1]
        entries = [json.loads(line) for line in lines]
        return [each for each in entries if each.get("event") == "write"]

    def attack(self, attack: str, number: int) -> Attack:
        """Run, attack at a random time, wait until all is over, and judge."""
        action, _, names = attack.partition(":")
        skip = self._log.stat().st_size
        output = self._folder / f"{attack.replace(':', '-')}-{number}.mcap"
        words = ["run", str(self._experiment), "--output", str(output), "--json"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        run = self._hilctl(words, self._disk, **quiet)
        while len(self._writes(skip)) < 10:
            assert run.poll() is None, f"the run ended by itself: {read(output).end}"
            time.sleep(0.02)
        processes = {"supervisor": run.pid, **_children(run.pid)}
        after_s = self._random.uniform(0.05, 1.5)
        time.sleep(after_s)
        hit = [processes[name] for name in names.split("+")]
        self._random.shuffle(hit)
        hit_ns = time.monotonic_ns()
        for process in hit:
            os.kill(process, signal.SIGKILL if action == "kill" else signal.SIGSTOP)
        time.sleep(OBSERVED_S)
        # A supervisor that was stopped is to close its recording; a run that goes on is to end.
        for number_ in (signal.SIGCONT, signal.SIGTERM):
            with suppress(ProcessLookupError):
                run.send_signal(number_)
        run.wait(LONGEST_S)
        _await_end([*processes.values()])
        self._hilctl(["status"], **quiet).wait()  # the next command of any kind recovers
        return self._judge(attack, after_s, hit_ns, self._writes(skip), output)

    def _judge(
        self, attack: str, after_s: float, hit_ns: int, writes: list[dict[str, Any]], path: Path
    ) -> Attack:
        recording = read(path)
        commands = recording.samples.command.astype(np.float32)
        put_out = np.array([each["value"] for each in writes], dtype=np.float32) * GAIN_A_PER_V
        times_ns = np.array([each["monotonic_ns"] for each in writes])
        return Attack(
            attack=attack,
            after_s=after_s,
            safe_ms=_uncontrolled_ms(times_ns, put_out, hit_ns),
            written=put_out.size,
            recorded=commands.size,
            lost=_lost(put_out, commands, recording.samples.flags),
            reason=recording.end.get("reason", "none"),
            other_reader=verdict(path, commands.size),
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


def _uncontrolled_ms(times_ns: np.ndarray, put_out: np.ndarray, hit_ns: int) -> float:
    """Return the longest time from ``hit_ns`` on without a write at an output that is not safe."""
    if put_out[-1] != 0.0:
        return float("inf")
    until_ns = times_ns[1:]
    stood_ns = until_ns - np.maximum(times_ns[:-1], hit_ns)
    unsafe = (put_out[:-1] != 0.0) & (until_ns > hit_ns)
    return float(stood_ns[unsafe].max(initial=0) * 1e-6)


def _lost(put_out: np.ndarray, commands: np.ndarray, flags: np.ndarray) -> int:
    """Return how many writes are not in the recording.

    The device sees the value that it holds already when it is opened, each command in turn, and the
    safe value of the last resort; a last sample without answer may not have reached it.
    """
    sure = commands.size - int(np.count_nonzero(flags & Flag.UNANSWERED.value))
    best = put_out.size
    for before in range(3):
        for size in range(sure, commands.size + 1):
            rest = put_out[before:]
            if rest.size >= size and np.array_equal(rest[:size], commands[:size]):
                best = min(best, int(np.count_nonzero(rest[size:])))
    return best


def main() -> int:
    """Run it; exit code 1 where a write was lost, safety came late, or readers differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="attacks of each kind")
    parser.add_argument("--attacks", nargs="+", default=ATTACKS, metavar="kill:loop+guardian")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate-hz", type=float, default=500.0)
    parser.add_argument("--stall-s", type=float, default=0.0, help="time that a write takes")
    parser.add_argument("--within-ms", type=float, default=200.0)
    parser.add_argument("--json", action="store_true", help="print every attack as JSON")
    options = parser.parse_args()
    found: list[Attack] = []
    with tempfile.TemporaryDirectory(prefix="hilctl-kills-") as folder:
        runs = AttackedRuns(Path(folder), options.seed, options.rate_hz, options.stall_s)
        try:
            for attack in options.attacks:
                for number in range(options.count):
                    found.append(runs.attack(attack, number))
                    if not options.json:
                        print(found[-1], flush=True)
        finally:
            runs.close()
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
