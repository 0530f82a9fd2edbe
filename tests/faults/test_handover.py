"""Commands that take a device over from a guardian and are killed at any moment."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.faults.conftest import MODULE, each_kind
from tests.faults.test_lost_devices import Module, active, said

WITHIN_S = 5.0
"""Longest pause between two attempts of a guardian, on a busy machine."""
LONGEST_S = 4.0
"""What the slowest of the commands takes up to its first tick."""


class Taken:
    """A module that was pulled while a run drove it, and commands that try to take it over."""

    def __init__(self, folder, emulate, profile, run):
        self.folder = folder
        self.module = Module(emulate, profile("rtu_module"))
        section = {**MODULE, "profile": profile("rtu_module"), **self.module.place}
        section |= {"framing": "rtu", "timeout_s": 0.3}
        started = run(section, sample_rate_hz=100)
        assert started.end()["guardian_active"]
        self.experiment = started.output.with_suffix(".yaml")

    def words(self, command, number):
        output = ("--output", self.folder / f"{number}.mcap")
        steps = ("--vary", "waveform.amplitude=0.5,1", "--folder", self.folder / f"{number}")
        return {
            "run": ("run", self.experiment, *output),
            "safe": ("safe", self.experiment),
            "probe": ("devices", "probe", self.experiment),
            "recovery": ("status",),
            "campaign": ("sweep", self.experiment, *steps),
        }[command]

    def killed(self, command, number, after_s, *, whole):
        """Start a command, and kill it or all of its processes after that time."""
        words = [sys.executable, "-m", "hilctl", *map(str, self.words(command, number))]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(words, start_new_session=True, **quiet)
        time.sleep(after_s)
        found = [process.pid]
        with suppress(FileNotFoundError):
            path = Path(f"/proc/{process.pid}/task/{process.pid}/children")
            found += map(int, path.read_text().split())
        for pid in found if whole else found[:1]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait(60.0)

    def returns(self):
        """Let the module return; return the time until its output is at the safe value."""
        self.module.come_back()
        began_s = time.monotonic()
        while not any(abs(each) < 1e-5 for each in self.module.writes_a()):
            if time.monotonic() > began_s + 60.0:
                return float("inf")
            time.sleep(0.01)
        return time.monotonic() - began_s

    def await_set(self):
        """Wait until the device has confirmed the value, and a guardian says so."""
        deadline_s = time.monotonic() + WITHIN_S
        expected = ("setting the safe value", "set")
        while expected not in [(run["state"], run.get("output_state")) for run in active()]:
            assert time.monotonic() < deadline_s

    def goes(self):
        self.module.emulated.end()


def tried(taken, command, chance, count):
    """Return the times until the output was safe, of kills at random moments."""
    found = []
    for number in range(count):
        taken.killed(command, number, chance.uniform(0.05, LONGEST_S), whole=chance.random() < 0.5)
        found.append(taken.returns())
        taken.await_set()
        taken.goes()
    return found


@pytest.mark.parametrize("command", each_kind(["run", "safe"], {"run"}))
def test_the_output_is_safe_although_the_command_that_takes_over_is_killed(
    tmp_path, emulate, profile, run, command
):
    taken = Taken(tmp_path, emulate, profile, run)
    assert max(tried(taken, command, random.Random(command), 3)) < WITHIN_S


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("command", ["run", "safe", "probe", "recovery", "campaign"])
def test_the_output_is_safe_after_fifty_kills(tmp_path, emulate, profile, run, command):
    taken = Taken(tmp_path, emulate, profile, run)
    found = sorted(tried(taken, command, random.Random(f"{command} 50"), 50))
    print(json.dumps({"command": command, "median_s": found[25], "largest_s": found[-1]}))
    assert found[-1] < WITHIN_S
    assert said("stop", "--run", active()[0]["name"])["ended"]
