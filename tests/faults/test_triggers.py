"""Runs that wait for a digital input, in processes of their own and in real time."""

import os
import signal
import time
from datetime import datetime

import numpy as np
import pytest

from hilctl.base.events import TRIGGERED
from hilctl.base.samples import Flag
from hilctl.recording.reader import read
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import runs
from tests.faults.conftest import PATIENT_TIMING, StartedRun, simulated, sine

RATE_HZ = 1000
WAITING = simulated(
    "triggered",
    RATE_HZ,
    sine(10.0, 0.5, soft_start_s=0.0),
    timing=PATIENT_TIMING,
    # The simulated input is high after a second.
    trigger={"output": "cycle", "start": "high"},
)


@pytest.mark.slow
def test_a_run_in_real_time_starts_with_the_input(tmp_path):
    run = StartedRun(tmp_path, WAITING)
    assert run.ended()[0] == 0
    recording = read(run.output)
    event = next(each for each in recording.events if each.code == TRIGGERED)
    assert event.sample == 0
    started, ended = map(datetime.fromisoformat, (recording.run["started"], recording.end["ended"]))
    after_s = (ended - started).total_seconds() - recording.samples.index.size / RATE_HZ
    assert -0.01 < after_s < event.values["waited_s"]  # the wait is not part of the run
    marks = np.flatnonzero(recording.samples.flags & Flag.TRIGGER)
    assert (marks - recording.segments[0].start).tolist() == [0, 100, 200, 300, 400]


@pytest.mark.slow
@pytest.mark.parametrize(("victim", "ends"), [("loop", "fault"), ("supervisor", "stopped")])
def test_a_run_that_is_killed_in_the_wait_leaves_a_readable_recording(tmp_path, victim, ends):
    run = StartedRun(tmp_path, WAITING)
    assert any("waiting" in line for line in run.process.stderr)
    os.kill(run.loop_pid() if victim == "loop" else run.process.pid, signal.SIGKILL)
    if victim == "loop":
        code, printed = run.ended()
        assert (code, printed["code"], printed["output_safe"]) == (3, "fault", True)
    else:
        run.process.communicate()
        while any(each.alive for each in runs()):
            time.sleep(0.02)
        recover_dead_runs()
    end = read(run.output).end
    assert (end["code"], end["output_safe"]) == (ends, "true")
