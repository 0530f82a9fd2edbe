"""Runs whose shared memory files are removed, as systemd-logind does at logout."""

import os
import shutil
import signal
import subprocess
import time

import pytest

from hilctl.recording.reader import read
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import base_folder, runs
from tests.commands import typed
from tests.faults.test_daemon import STOPPED, await_state, hilctl, start, stop_all


@pytest.fixture
def logged_out(tmp_path):
    """Recording of a background run after a logout."""
    recording = start(tmp_path)
    shutil.rmtree(base_folder())
    yield recording
    stop_all()


def test_run_is_found_changed_watched_and_stopped_after_a_logout(logged_out):
    """All commands work, and the recording is complete."""
    assert await_state("running")["recording"] == str(logged_out)
    pipe = subprocess.PIPE
    with subprocess.Popen(typed("watch"), stdout=pipe, stderr=pipe, text=True) as watching:
        assert watching.stdout.readline()
        watching.terminate()
        assert "Traceback" not in watching.communicate(timeout=60)[1]
    assert hilctl("set", "gain=0.5", "--over", "0.1")["gain"] == 0.5
    hilctl("mark", "logged in again")
    (ended,) = hilctl("stop", "--all")["runs"]
    assert ended["ended"]
    recording = read(logged_out)
    assert recording.end["reason"] == STOPPED
    assert "mark" in {event.code for event in recording.events}
    assert recording.dropped == 0
    assert hilctl("status")["runs"] == []


def test_a_supervisor_that_crashes_afterwards_loses_no_sample(logged_out):
    """The loop ramps down and saves unrecorded samples for the next command."""
    await_state("running")
    (run,) = runs()
    os.kill(run.card.supervisor, signal.SIGKILL)
    deadline = time.monotonic() + 60.0
    while run.alive or not any(base_folder().glob("*/run.json")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    (orphan,) = recover_dead_runs()
    assert orphan.safe
    recording = read(logged_out)
    assert recording.end["reason"] == "stopped because the supervisor died"
    assert recording.end["recorded_samples"] == str(recording.samples.index.size)
    assert recording.dropped == 0
    assert abs(recording.samples.command[-1]) < 0.01  # the complete ramp is recorded
    assert runs() == []
