"""Two users of one device: the second run is rejected and names the first."""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
import yaml

from tests.commands import hilctl
from tests.faults.conftest import EXPERIMENT

# A slow rate for a busy machine, and long enough for a second run.
PATIENT = {
    "sample_rate_hz": 50,
    "waveform": {**EXPERIMENT["waveform"], "duration_s": 3600.0},
    "timing": {"max_missed_share": 1.0, "max_late_s": 30.0},
}


TRIALS = 20


class Neighbour:
    """Another user with a separate folder."""

    def __init__(self, words, folder, section):
        self._words, self.folder, self.process = words, folder, None
        text = yaml.safe_dump({**EXPERIMENT, **PATIENT, "device": section})
        (folder / "theirs.yaml").write_text(text, encoding="utf-8")

    def start(self, *more):
        command = [sys.executable, "-P", "-m", "hilctl", "run", "theirs.yaml", "--json"]
        self.process = subprocess.Popen(
            [*self._words, *command, "--output", "theirs.mcap", *more],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "HILCTL_RUNS": str(self.folder / "runs"), "HOME": "/nonexistent"},
        )
        return self.process


@pytest.fixture
def neighbour(nobody, device):
    # Not below tmp_path, which only this user can read.
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chown(folder, *(int(each.partition("=")[2]) for each in nobody[1:3]))
        made = Neighbour(nobody, folder, device.section)
        yield made
        if made.process is not None and made.process.poll() is None:
            made.process.kill()
            made.process.communicate()


def test_the_second_user_of_a_device_is_refused(neighbour, device, run):
    """The second run is rejected with one message, and the first continues."""
    mine = run(device.section, **PATIENT)
    device.log.await_events("DAC0", 40, mine.process)
    theirs = neighbour.start()
    out, err = theirs.communicate(timeout=240)
    assert theirs.returncode == 2, err
    assert len(err.splitlines()) == 1
    assert f"process {mine.process.pid} of root" in err
    assert json.loads(out)["error"]
    assert not (neighbour.folder / "theirs.mcap").exists()
    device.log.await_events("DAC0", len(device.log.events("DAC0")) + 20, mine.process)
    assert mine.interrupt()["code"] == "stopped"


@pytest.mark.long  # the other user compiles the kernels
def test_a_device_that_another_user_has_is_refused_unless_taken_over(neighbour, device, run):
    theirs = neighbour.start()
    device.log.await_events("DAC0", 40, theirs)
    mine = run(device.section, **PATIENT)
    assert f"process {theirs.pid} of nobody" in mine.refused()
    path = mine.output.with_suffix(".yaml")
    written = len(device.log.events("DAC0"))
    short = ("--set", "waveform.duration_s=0.5", "--output", path.with_name("short.mcap"))
    hilctl("run", path, "--take-over", *short)
    assert len(device.log.events("DAC0")) > written + 20
    theirs.terminate()
    out, err = theirs.communicate(timeout=240)
    assert "Traceback" not in err
    assert json.loads(out)["output_safe"]
    assert (neighbour.folder / "theirs.mcap").stat().st_uid != os.geteuid()


SQUATTER = """
import hashlib, socket, sys
taken = socket.socket(socket.AF_UNIX)
taken.bind(b"\\0hilctl/device/" + hashlib.sha256(sys.argv[1].encode()).hexdigest().encode())
taken.listen()
print("taken", flush=True)
input()
"""


def test_user_who_binds_the_name_does_not_prevent_the_safe_value(nobody, device, run, tmp_path):
    """A run can ignore the name, and ``hilctl safe`` does."""
    section = device.section
    name = f"tcp:{section['host']}:{section['tcp_port']}"
    squatter = subprocess.Popen(
        [*nobody, sys.executable, "-c", SQUATTER, name],
        cwd="/", stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert squatter.stdout.readline() == "taken\n"
        mine = run(section, **PATIENT)
        assert f"process {squatter.pid} of nobody" in mine.refused()
        path = tmp_path / "run.yaml"
        assert "confirmed" in hilctl("safe", path).stdout
        short = ("--set", "waveform.duration_s=0.5", "--output", path.with_name("short.mcap"))
        hilctl("run", path, "--take-over", *short)
    finally:
        squatter.communicate("\n", timeout=60)


@pytest.mark.long
def test_second_user_with_another_name_of_the_device_is_refused(neighbour, device, run):
    chance = random.Random(TRIALS)
    for trial in range(TRIALS):
        theirs = neighbour.start("--set", "device.host=localhost", "--overwrite")
        time.sleep(chance.uniform(0.0, 0.5))
        mine = run(device.section, name=f"mine{trial}", **PATIENT).process
        deadline = time.monotonic() + 60.0
        while theirs.poll() is None and mine.poll() is None:
            assert time.monotonic() < deadline, "both run"
            time.sleep(0.02)
        refused, other = (mine, theirs) if theirs.poll() is None else (theirs, mine)
        assert refused.communicate()[1].count("in use by") == 1
        assert refused.returncode == 2
        other.terminate()
        printed = json.loads(other.communicate(timeout=60)[0])
        assert printed.get("output_safe") or "nothing has moved" in printed["error"]
