"""Kill a run's processes at random times, and judge by the emulated device's own log of writes.

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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from other_reader import NOT_INSTALLED, verdict

from hilctl.base.samples import Flag
from hilctl.recording.reader import read

RATE_HZ = 500
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
    "sample_rate_hz": RATE_HZ,
    "waveform": {
        "kind": "sine",
        "unit": "A",
        "amplitude": 4.0,
        "frequency_hz": 2.0,
        "duration_s": 60.0,
        "soft_start_s": 0.1,
    },
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": RAMP_S},
}


@dataclass
class Kill:
    """What one kill came to.

    Attributes:
        victim: ``loop`` or ``supervisor``.
        after_s: Time from the first write to the kill.
        safe_ms: Time from the kill to the last write, which was the safe value; NaN if it was not.
        written: Writes that the device saw.
        recorded: Samples in the recording.
        lost: Writes whose command is not in the recording, in order.
        reason: What the recording says of the end.
        other_reader: Where another program's reading of the recording differs; empty where not.
    """

    victim: str
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


class KilledRuns:
    """An emulated device and experiments that use it."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder = folder
        self._random = random.Random(seed)
        self._environment = {**os.environ, "HILCTL_RUNS": str(folder / "runs")}
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
        self._experiment = folder / "experiment.yaml"
        self._experiment.write_text(yaml.safe_dump({**EXPERIMENT, "device": device}))

    def close(self) -> None:
        """Stop the emulator."""
        self._emulator.terminate()
        self._emulator.wait()

    def _hilctl(self, words: list[str], **options: Any) -> subprocess.Popen[Any]:
        command = [sys.executable, "-m", "hilctl.cli", *words]
        return subprocess.Popen(command, env=self._environment, **options)

    def _writes(self, skip: int) -> list[dict[str, Any]]:
        lines = self._log.read_bytes()[skip:].split(b"\n")[:-1]
        entries = [json.loads(line) for line in lines]
        return [each for each in entries if each.get("event") == "write"]

    def kill(self, victim: str, number: int) -> Kill:
        """Run, kill at a random time, wait until all is over, and judge."""
        skip = self._log.stat().st_size
        output = self._folder / f"{victim}-{number}.mcap"
        words = ["run", str(self._experiment), "--output", str(output), "--json"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        run = self._hilctl(words, **quiet)
        while len(self._writes(skip)) < 10:
            assert run.poll() is None, "the run ended by itself"
            time.sleep(0.02)
        loop = int(Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()[0])
        after_s = self._random.uniform(0.05, 1.5)
        time.sleep(after_s)
        killed_ns = time.monotonic_ns()
        os.kill(loop if victim == "loop" else run.pid, signal.SIGKILL)
        run.wait()
        while Path(f"/proc/{loop}").exists():
            time.sleep(0.005)
        self._hilctl(["status"], **quiet).wait()  # the next command of any kind recovers
        return self._judge(victim, after_s, killed_ns, self._writes(skip), output)

    def _judge(
        self, victim: str, after_s: float, killed_ns: int, writes: list[dict[str, Any]], path: Path
    ) -> Kill:
        last = writes[-1]
        safe = last["value"] == 0.0
        recording = read(path)
        commands = recording.samples.command.astype(np.float32)
        put_out = np.array([each["value"] for each in writes], dtype=np.float32) * GAIN_A_PER_V
        return Kill(
            victim=victim,
            after_s=after_s,
            safe_ms=(last["monotonic_ns"] - killed_ns) * 1e-6 if safe else float("nan"),
            written=put_out.size,
            recorded=commands.size,
            lost=_lost(put_out, commands, recording.samples.flags),
            reason=recording.end.get("reason", "none"),
            other_reader=verdict(path, commands.size),
        )


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
    parser.add_argument("--count", type=int, default=30, help="kills of each process")
    parser.add_argument("--victims", nargs="+", default=["loop", "supervisor"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--within-ms", type=float, default=200.0)
    parser.add_argument("--json", action="store_true", help="print every kill as JSON")
    options = parser.parse_args()
    kills: list[Kill] = []
    with tempfile.TemporaryDirectory(prefix="hilctl-kills-") as folder:
        killed = KilledRuns(Path(folder), options.seed)
        try:
            for victim in options.victims:
                for number in range(options.count):
                    kills.append(killed.kill(victim, number))
                    if not options.json:
                        print(kills[-1], flush=True)
        finally:
            killed.close()
    if options.json:
        print(json.dumps([asdict(kill) for kill in kills], indent=2))
    else:
        _print_summary(options.victims, kills)
    return 0 if all(kill.is_good(options.within_ms) for kill in kills) else 1


def _print_summary(victims: list[str], kills: list[Kill]) -> None:
    for victim in victims:
        chosen = [kill for kill in kills if kill.victim == victim]
        times = np.array([kill.safe_ms for kill in chosen])
        print(
            f"{victim}: {times.size} kills, safe after {np.median(times):.0f} ms median, "
            f"{times.max():.0f} ms worst; {sum(kill.lost for kill in chosen)} writes lost of "
            f"{sum(kill.written for kill in chosen)}; @mcap/core {_agreement(chosen)}"
        )


def _agreement(kills: list[Kill]) -> str:
    said = {kill.other_reader for kill in kills}
    return "agrees" if said == {""} else " and ".join(sorted(said - {""}))


if __name__ == "__main__":
    sys.exit(main())
