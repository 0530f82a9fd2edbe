"""Processes that are killed, stopped, or find garbage in the memory they share."""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import runs
from hilctl.run.shared.shared_page import SIZE
from tests.benchmark.other_reader import is_installed
from tests.commands import ended
from tests.faults.conftest import StartedRun, simulated, sine

ROOT = Path(__file__).parents[2]
EXPERIMENT = simulated(
    "process_fault",
    1000,
    sine(5.0, 60.0),
    timing={"max_late_s": 3.0, "max_missed_share": 1.0},
    recording={"flush_s": 0.1, "ring_s": 5.0},
)


def begun(folder, **changes):
    """Return a run that exchanges samples."""
    run = StartedRun(folder, {**EXPERIMENT, **changes})
    run.await_size(20_000)
    run.loop = run.loop_pid()
    return run


def contiguous(recording):
    return np.array_equal(recording.samples.index, np.arange(recording.samples.index.size))


@pytest.mark.parametrize(("action", "targets", "phase", "stall_s"), [
    pytest.param("kill", "loop", "run", 3.0, marks=pytest.mark.long),
    ("kill", "supervisor", "run", 0.0),
    ("kill", "loop+supervisor", "set", 3.0),
    pytest.param("stop", "loop+supervisor", "ramp out", 0.0, marks=pytest.mark.long),
    ("stop", "loop+guardian", "condition", 0.0),
])  # fmt: skip
def test_killed_and_stopped_processes_leave_a_safe_output_and_a_whole_recording(
    action, targets, phase, stall_s
):
    """By the device's own log, every write is in the file, and the last is the safe value."""
    if not is_installed() and not os.environ.get("CI"):
        pytest.skip("tests/peers/node_modules is not there: run npm ci in tests/peers")
    words = [sys.executable, "-m", "tests.benchmark.kills", "--count", "1", "--json"]
    words += ["--within-ms", "1500", "--max-step", "2"]  # others may have the machine
    words += ["--action", action, "--targets", targets, "--phase", phase]
    done = ended([*words, "--stall-s", str(stall_s)], cwd=ROOT)
    found = json.loads(done.stdout)
    assert (found["phase"], found["lost"], found["reader"]) == (phase, 0, "")
    assert action in found["hit"]


def test_loop_that_hangs_is_killed_and_the_device_made_safe(tmp_path):
    """The exchanged samples are in the file."""
    run = begun(tmp_path)
    os.kill(run.loop, signal.SIGSTOP)
    returned, printed = run.ended()
    assert returned == 3
    assert printed["reason"] == "the loop process hung, and was killed"
    assert printed["output_safe"]
    recording = read(run.output)
    assert contiguous(recording)
    assert recording.end["code"] == "fault"
    assert replay(recording).identical


def test_short_stop_of_the_loop_costs_no_sample(tmp_path):
    """Below the limit the run continues, and catches up with a device that has its own clock."""
    run = begun(tmp_path)
    os.kill(run.loop, signal.SIGSTOP)
    time.sleep(0.4)
    os.kill(run.loop, signal.SIGCONT)
    time.sleep(0.5)
    run.process.send_signal(signal.SIGINT)
    returned, _printed = run.ended()
    assert returned == 130
    recording = read(run.output)
    assert contiguous(recording)
    assert recording.dropped == 0
    assert int(recording.end["worst_late_ns"]) >= 0.9e9 * 0.4
    assert replay(recording).identical


def test_stop_beyond_the_limit_ends_the_run(tmp_path):
    """A loop that wakes too late ramps down, if it was not killed before."""
    run = begun(tmp_path, timing={"max_late_s": 0.3})
    os.kill(run.loop, signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(run.loop, signal.SIGCONT)
    returned, printed = run.ended()
    assert returned == 3
    assert "late, more than timing.max_late_s" in printed["reason"] or "hung" in printed["reason"]
    assert printed["output_safe"]


def test_silent_supervisor_ends_the_run(tmp_path):
    """Before the ring is full the loop ramps down by itself; nothing is lost."""
    run = begun(tmp_path)
    os.kill(run.process.pid, signal.SIGSTOP)
    deadline = time.monotonic() + 240.0
    while Path(f"/proc/{run.loop}/stat").read_text().split()[2] != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(run.process.pid, signal.SIGCONT)
    returned, printed = run.ended()
    assert returned == 3
    assert "supervisor was silent for 2.5 s" in printed["reason"]
    assert "CPUs; the loop was late in" in printed["reason"]
    recording = read(run.output)
    assert contiguous(recording)
    assert recording.dropped == 0
    assert recording.samples.command[-1] == 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_run_ends_despite_garbage_in_the_ring(tmp_path, seed):
    """The run ends and its recording is readable, whatever is overwritten."""
    run = begun(tmp_path)
    (folder,) = runs()
    chance = random.Random(seed)
    with folder.ring.open("r+b") as ring:
        size = ring.seek(0, os.SEEK_END)
        for _ in range(30):
            ring.seek(chance.randrange(SIZE, size - 200))
            ring.write(chance.randbytes(200))
    time.sleep(0.5)
    run.process.send_signal(signal.SIGINT)
    returned, printed = run.ended()
    assert returned in {130, 3}
    assert printed["output_safe"]
    assert read(run.output).end["reason"] == printed["reason"]


def test_death_of_both_processes_is_reported_and_recovered(tmp_path):
    """No process can make the output safe: the next command reports it and saves the samples."""
    run = begun(tmp_path)
    os.kill(run.process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(run.loop, signal.SIGKILL)
    run.process.kill()
    run.process.communicate()
    (orphan,) = recover_dead_runs()
    assert not orphan.safe
    assert "NOT confirmed to be safe" in orphan.text
    recording = read(run.output)
    assert contiguous(recording)
    assert recording.end["reason"] == "supervisor and loop died"
    assert recording.end["output_safe"] == "false"
    assert replay(recording).identical


def test_run_of_a_program_with_threads(tmp_path):
    """In another thread than the main one, with signal handlers of the program."""
    demo = str(ROOT / "configs" / "demo.yaml")
    code = f"""
import signal, threading
from hilctl import api

def own(number, frame):
    pass

signal.signal(signal.SIGUSR1, own)
results, shown = [], []

def run(number):
    output, settings = f"{tmp_path}/{{number}}.mcap", {{"waveform.duration_s": 0.5}}
    results.append(api.run({demo!r}, output, settings=settings, on_progress=shown.append).code)

thread = threading.Thread(target=run, args=(1,))
thread.start()
thread.join()
stop = threading.Event()
thread = threading.Thread(target=stop.wait)
thread.start()
run(2)
stop.set()
thread.join()
run(3)
print(results, bool(shown), signal.getsignal(signal.SIGUSR1) is own)
"""
    ran = ended([sys.executable, "-c", code])
    assert ran.stdout == "['completed', 'completed', 'completed'] True True\n", ran.stderr
