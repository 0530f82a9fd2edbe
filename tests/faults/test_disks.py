"""Runs with a full or slow disk, or a wall clock that is set: losses are counted."""

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.run_folder import runs
from tests.faults.conftest import StartedRun, simulated, sine

DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
RATE_HZ = 5000
SECONDS = 4.0
RAMP_SAMPLES = round(0.2 * RATE_HZ)
EXPERIMENT = simulated("disk_fault", RATE_HZ, sine(5.0, SECONDS), block=5)
FAULTY = """
import os, sys, time
from io import FileIO
from hilctl.recording import writer
from hilctl import cli

class Faulty(FileIO):
    '''A file with one write fault after some bytes.'''

    due = True

    def write(self, data):
        if self.due and self.tell() > {at_bytes}:
            self.due = False
            {fault}
        return super().write(data)

class Pending(writer.PendingFile):
    def __init__(self, raw, **options):
        super().__init__(Faulty(os.dup(raw.fileno()), "wb"), **options)

writer.PendingFile = Pending
sys.argv = ["hilctl", *sys.argv[1:]]
sys.exit(cli.main())
"""
EIO = FAULTY.format(at_bytes=100_000, fault="raise OSError(5, 'Input/output error')")


def stall(seconds: float) -> str:
    """Return a program whose disk stalls once."""
    return FAULTY.format(at_bytes=200_000, fault=f"time.sleep({seconds})")


OTHER_CLOCK = """
import datetime, os, time
from pathlib import Path

def stepped(now_ns=time.time_ns, path=Path(os.environ["CLOCK_STEP"])):
    return now_ns() + int(path.read_text() or 0)

class Stepped(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return cls.fromtimestamp(stepped() * 1e-9, tz)

time.time_ns, time.time = stepped, lambda: stepped() * 1e-9
datetime.datetime = Stepped
"""


def start(folder: Path, *, code: str = "", options=None, **recording) -> StartedRun:
    """Start a run in a separate process; ``code`` replaces ``python -m hilctl``."""
    section = {"flush_s": 0.1, "ring_s": 1.0, **recording}
    program = ("-c", code) if code else ()
    experiment = {**EXPERIMENT, "recording": section}
    return StartedRun(folder, experiment, program=program, **(options or {}))


def end(run: StartedRun, code: int) -> dict:
    """Wait for the end; return the printed JSON."""
    returned, printed = run.ended()
    assert returned == code, printed
    return printed


def limit_files(run: StartedRun, size: int) -> None:
    resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def assert_whole(recording, printed) -> None:
    """Assert that the recording has every sample once and replays bit for bit."""
    index = recording.samples.index
    assert np.array_equal(index, np.arange(index.size))
    assert (recording.dropped, printed["dropped"]) == (0, 0)
    assert printed["recorded_samples"] == index.size
    assert replay(recording).identical


@pytest.mark.parametrize("on_failure", ["stop", "go_on"])
def test_one_refused_write_loses_nothing(tmp_path, on_failure):
    printed = end(start(tmp_path, code=EIO, on_failure=on_failure), 0)
    assert printed["reason"] == "waveform completed"
    recording = read(tmp_path / "run.mcap")
    assert_whole(recording, printed)
    assert recording.samples.index.size >= round(SECONDS * RATE_HZ)
    assert [each.code for each in recording.events] == ["recording_retried", "run_ended"]


@pytest.mark.parametrize("on_failure", ["stop", "go_on"])
def test_disk_that_is_full_for_a_while_loses_nothing(tmp_path, on_failure):
    run = start(tmp_path, on_failure=on_failure, ring_s=8.0)
    run.await_size()
    limit_files(run, 200_000)
    time.sleep(1.0)
    limit_files(run, resource.RLIM_INFINITY)
    printed = end(run, 0)
    assert printed["reason"] == "waveform completed"
    assert_whole(read(tmp_path / "run.mcap"), printed)


@pytest.mark.parametrize(
    ("on_failure", "whole"), [("stop", False), ("go_on", True)], ids=["stop", "go_on"]
)
def test_disk_that_stays_full(tmp_path, on_failure, whole):
    """The run ramps down or continues to its end; the next command completes the recording."""
    run = start(tmp_path, on_failure=on_failure, ring_s=5.0 if whole else 3.0)
    run.await_size()
    limit_files(run, 200_000)
    printed = end(run, 3)
    assert printed["code"] == "fault"
    assert printed["output_safe"]
    assert "File too large" in printed["reason"]
    assert printed["reason"].startswith("waveform completed") == whole
    recorded = read(tmp_path / "run.mcap").samples.index
    assert np.array_equal(recorded, np.arange(recorded.size))
    assert recorded.size >= printed["recorded_samples"] > 1000
    total = printed["recorded_samples"] + printed["dropped"]
    waveform = round(SECONDS * RATE_HZ)
    assert (waveform <= total <= waveform + RAMP_SAMPLES) if whole else total < waveform
    (left,) = runs()
    assert str(left.path) in printed["reason"]
    finish_dead_runs()
    recording = read(tmp_path / "run.mcap")
    assert_whole(recording, {"dropped": 0, "recorded_samples": total})
    assert recording.end["code"] == ("completed" if whole else "stopped")
    assert not runs()


def test_stall_longer_than_the_ring_ends_the_run(tmp_path):
    """The loop ramps down before the ring is full: nothing is lost."""
    run = start(tmp_path, code=stall(2.0), on_failure="stop")
    printed = end(run, 3)
    assert "disk stalls" in printed["reason"]
    assert printed["output_safe"]
    recording = read(tmp_path / "run.mcap")
    assert recording.dropped == 0
    assert np.array_equal(recording.samples.index, np.arange(recording.samples.index.size))
    assert recording.samples.command[-1] == 0.0
    assert replay(recording).identical


def test_continued_run_counts_the_samples_lost_by_a_slow_disk(tmp_path):
    """The ring holds one second; the number of lost samples is reported and recorded."""
    run = start(tmp_path, code=stall(2.5), on_failure="go_on")
    printed = end(run, 0)
    assert printed["reason"] == "waveform completed"
    recording = read(tmp_path / "run.mcap")
    index = recording.samples.index
    gaps = np.diff(index) - 1
    assert recording.dropped == printed["dropped"] == gaps.sum()
    assert printed["dropped"] > RATE_HZ
    assert index.size + printed["dropped"] == index[-1] + 1
    assert int(recording.end["dropped_in_ring"]) == printed["dropped"]
    # A loop that waits for the disk would be later than a busy machine makes it.
    assert int(recording.end["worst_late_ns"]) < 2.0e9
    assert replay(recording).identical


def test_stall_shorter_than_the_ring_loses_nothing(tmp_path):
    """A stall within the ring's capacity is no fault."""
    printed = end(start(tmp_path, code=stall(3.0), ring_s=10.0), 0)
    assert printed["reason"] == "waveform completed"
    assert_whole(read(tmp_path / "run.mcap"), printed)


def test_wall_clock_that_is_set_changes_nothing(tmp_path):
    """Setting the clock one hour back and two forward does not change a run's timestamps."""
    clock, output = tmp_path / "clock", tmp_path / "run.mcap"
    clock.write_text("0", encoding="utf-8")
    (tmp_path / "sitecustomize.py").write_text(OTHER_CLOCK, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "CLOCK_STEP": str(clock)}
    before_ns = time.time_ns()
    run = start(tmp_path, options={"env": environment})
    run.await_size()
    for step_s in (-3600, 7200):
        clock.write_text(str(step_s * 10**9), encoding="utf-8")
        time.sleep(1.0)
    printed = end(run, 0)
    assert (printed["reason"], printed["dropped"]) == ("waveform completed", 0)
    recording = read(output)
    assert replay(recording).identical
    assert set(np.diff(recording.ticks.deadline_ns).tolist()) == {1_000_000}
    start_ns = int(recording.run["start_unix_ns"])
    assert 0 <= start_ns - before_ns < 60e9
    (ended,) = recording.events
    assert SECONDS <= (ended.time_ns - start_ns) * 1e-9 < SECONDS + 60.0


def test_missing_memory_is_one_message(tmp_path):
    """Without memory for the ring the run does not start, leaves no file and prints one line."""

    def nothing() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    process = start(tmp_path, options={"preexec_fn": nothing}).process
    _, err = process.communicate(timeout=240)
    assert process.returncode == 3, err
    assert err.count("\n") == 1
    assert "recording.ring_s" in err
    assert not (tmp_path / "run.mcap").exists()


def test_full_disk_of_standard_output_is_no_fault_of_the_run(tmp_path):
    """A full disk on standard output is reported and does not change the run's result."""
    output = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "hilctl", "run", str(DEMO)]
    command += ["--set", "waveform.duration_s=0.5", "--output", str(output), "--json"]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=240)
    assert ended.returncode == 0, ended.stderr
    assert "No space left" in ended.stderr
    assert read(output).end["code"] == "completed"
