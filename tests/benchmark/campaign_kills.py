"""Kill a campaign at random moments, and judge what it has left once it is done.

Run it with ``python -m tests.benchmark.campaign_kills``; see README.md beside it.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import datetime
from pathlib import Path

from hilctl.experiment.heat import CoilHeat, cooled
from hilctl.experiment.load import load_experiment
from hilctl.recording.ends import read_ends
from hilctl.recording.facts import HEAT_FACT
from hilctl.recording.reader import read
from hilctl.recording.salvage import Salvage
from hilctl.run.step import completed_key

EXPERIMENT = """\
name: rig
device: {kind: simulated_terfenol}
sample_rate_hz: 2000
block: 20
waveform: {kind: sine, unit: A, amplitude: 2.0, frequency_hz: 5.0, duration_s: 1.0}
compensator: none
limits:
  peak_current_a: 4.0
  slew_a_per_s: 500.0
  stroke_um: [-75.0, 60.0]
  rms_current_a: 2.5
  thermal_time_constant_s: 20.0
recording: {flush_s: 0.2, ring_s: 2.0}
timing: {on_misses: warn}
"""
CAMPAIGN = """\
name: killed
experiment: rig.yaml
vary: {{waveform.amplitude: "1.0:3.5:{steps}"}}
order: random
reference_run: {{every: 10}}
"""
BEYOND_S = 3.0
IN_RUNS = 0.7
TOLERANCE = 0.02
MOST_FAULTS = 10
_LAST_WORDS = 60


class KilledCampaign:
    """A campaign in a folder of its own.

    Args:
        folder: Where.
        steps: How many values it has.
        words: More of its command line.
    """

    def __init__(self, folder: Path, steps: int, words: list[str]) -> None:
        self.runs = folder / "runs"
        (folder / "rig.yaml").write_text(EXPERIMENT, encoding="utf-8")
        file = folder / "killed.yaml"
        file.write_text(CAMPAIGN.format(steps=steps), encoding="utf-8")
        self._folder = folder
        self._command = [sys.executable, "-m", "hilctl", "campaign", str(file)]
        self._command += ["--folder", str(self.runs), *words]
        self._environment = {**os.environ, "HILCTL_RUNS": str(folder / "memory")}
        self._known: dict[Path, str] = {}
        self.changed: list[str] = []

    def start(self) -> subprocess.Popen[bytes]:
        """Start it, or go on with it."""
        log = (self._folder / "log").open("ab")
        return subprocess.Popen(self._command, env=self._environment, stdout=log, stderr=log)

    def kill(self, after_s: float, *, in_runs: bool) -> int:
        """Start it and kill it; return its exit code, which says whether it was still running.

        Args:
            after_s: How long after.
            in_runs: After its first new recording, not after its start.
        """
        process, before = self.start(), len([*self.runs.glob("*.mcap")])
        while in_runs and process.poll() is None:
            if len([*self.runs.glob("*.mcap")]) > before:
                break
            time.sleep(0.02)
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        self.look()
        return process.returncode

    def finish(self) -> int:
        """Let it come to its end; return its exit code."""
        code = self.start().wait()
        self.look()
        return code

    def said(self) -> str:
        """Return the last words of what it has printed."""
        words = (self._folder / "log").read_text(encoding="utf-8", errors="replace").split()
        return " ".join(words[-_LAST_WORDS:])

    def look(self) -> None:
        """Note every completed recording; one that was seen before must be what it was."""
        for path in sorted(self.runs.glob("*.mcap")):
            if path in self._known or completed_key(path) is not None:
                digest = hashlib.sha256(path.read_bytes()).hexdigest()
                if self._known.setdefault(path, digest) != digest:
                    self.changed.append(path.name)

    def judge(self) -> dict[str, object]:
        """Return what is wrong with what it has left; counts of 0 and empty lists are good."""
        with (self.runs / "killed.csv").open(encoding="utf-8") as table:
            rows = table.read().splitlines()[1:]
        keys = [completed_key(path) for path in self.runs.glob("*.mcap")]
        counted = Counter(key for key in keys if key is not None)
        broken = [path.name for path in sorted(self.runs.glob("*.mcap")) if not _is_sound(path)]
        return {
            "steps": len(rows),
            "missing": sum(",completed," not in row for row in rows),
            "completed_runs_repeated": sum(count - 1 for count in counted.values()),
            "completed_runs": len(counted),
            "completed_runs_changed": self.changed,
            "broken_files": broken,
            "cut_short": sum(key is None for key in keys),
            "heat_lost": self._heat_lost(),
        }

    def _heat_lost(self) -> list[str]:
        """Return runs whose coil began colder than all currents before it have made it."""
        config = load_experiment(self._folder / "rig.yaml").config
        tau_s = config.limits.thermal_time_constant_s
        recordings = [read(path) for path in self.runs.glob("*.mcap")]
        heat_a2, at_s, lost = 0.0, 0.0, []
        for each in sorted(recordings, key=lambda each: each.run["started"]):
            started_s = datetime.fromisoformat(each.run["started"]).timestamp()
            heat_a2 = cooled(heat_a2, 0.0, tau_s, started_s - at_s)
            begun_a2 = float(each.run[HEAT_FACT])
            if begun_a2 < (1.0 - TOLERANCE) * heat_a2 - 1e-3:
                lost.append(f"{each.path.name}: {begun_a2:.4f} of {heat_a2:.4f} A^2")
            followed = CoilHeat(config.limits, config.sample_rate_hz, heat_a2)
            followed.follow(each.samples)
            heat_a2 = followed.heat_a2
            at_s = started_s + each.samples.index.size / config.sample_rate_hz
        return lost


def _is_sound(path: Path) -> bool:
    with path.open("rb") as stream:
        salvage = Salvage(stream)
        for _ in salvage.records():
            pass
    return salvage.sound and bool(read_ends(path).end)


def main() -> None:
    """Kill it, let it end, judge it; exit code 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fast", action="store_true", help="kill runs that keep no real time")
    options = parser.parse_args()
    chosen = random.Random(options.seed)
    with tempfile.TemporaryDirectory(prefix="hilctl-campaign-kills-") as folder:
        campaign = KilledCampaign(Path(folder), options.steps, ["--fast"] * options.fast)
        begun = time.monotonic()
        process = campaign.start()
        while not any(campaign.runs.glob("*.mcap")) and process.poll() is None:
            time.sleep(0.02)
        longest_s = time.monotonic() - begun + BEYOND_S
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed = 1
        faults: list[str] = []
        while killed < options.kills:
            in_runs = chosen.random() < IN_RUNS  # a busy machine takes long to start
            after_s = chosen.uniform(0.0, BEYOND_S if in_runs else longest_s)
            code = campaign.kill(after_s, in_runs=in_runs)
            if code == -signal.SIGKILL:
                killed += 1
            elif code == 0 or len(faults) == MOST_FAULTS:
                break  # it has come to its end
            else:  # a run of it failed, as on a machine too busy for it: it goes on from there
                faults.append(campaign.said())
        code = campaign.finish()
        found = {"kills": killed, "exit_code": code, "faults": faults, **campaign.judge()}
        if code:
            found["ended"] = campaign.said()
    print(json.dumps(found, indent=2))
    wrong = ("missing", "completed_runs_repeated", "completed_runs_changed", "broken_files")
    sys.exit(int(code != 0 or any(found[name] for name in (*wrong, "heat_lost"))))


if __name__ == "__main__":
    main()
