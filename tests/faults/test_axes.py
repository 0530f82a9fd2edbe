"""Runs of several simulated axes that are killed, logged out, or lack room on a disk."""

import os
import shutil
import signal
import time

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.base.errors import InputError
from hilctl.recording.reader import read
from hilctl.run.control.client import mark_run, set_run, status_of, stop_runs
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import base_folder, runs
from tests.faults.conftest import StartedRun, simulated, sine

EXPERIMENT = simulated(
    "axes",
    1000,
    sine(5.0, 60.0),
    timing={"max_late_s": 3.0, "max_missed_share": 1.0},
    recording={"flush_s": 0.1, "ring_s": 5.0},
    axes={"x": {"device": {"seed": 1}}, "y": {"device": {"seed": 2}}},
)


@pytest.fixture
def begun(tmp_path):
    """Return a run of two axes that exchanges samples."""
    run = StartedRun(tmp_path, EXPERIMENT)
    run.outputs = [tmp_path / f"run.{name}.mcap" for name in "xy"]
    run.output = run.outputs[1]
    run.await_size(20_000)
    run.loop = run.loop_pid()
    yield run
    run.process.kill()
    run.process.communicate()


def assert_complete(run, reason):
    """Both recordings hold every sample up to the same end, and are replayed."""
    found = [read(each) for each in run.outputs]
    for each in found:
        assert np.array_equal(each.samples.index, np.arange(each.samples.index.size))
        assert each.dropped == 0
        assert each.end["reason"].startswith(reason)
        assert replay(each).identical
    assert found[0].samples.index.size == found[1].samples.index.size
    assert runs() == []


def test_both_processes_killed(begun):
    os.kill(begun.process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(begun.loop, signal.SIGKILL)
    begun.process.kill()
    begun.process.communicate()
    orphans = recover_dead_runs()
    assert [each.recording for each in orphans] == begun.outputs
    assert not any(each.kept for each in orphans)
    assert_complete(begun, "supervisor and loop died")
    assert recover_dead_runs() == []


def test_loop_killed(begun):
    os.kill(begun.loop, signal.SIGKILL)
    code, printed = begun.ended()
    assert (code, printed["code"]) == (3, "fault")
    assert_complete(begun, "the loop process died: killed by SIGKILL")


def test_supervisor_killed_after_a_logout(begun):
    """The loop ramps down, and restores the rings of both axes."""
    shutil.rmtree(base_folder())
    begun.process.kill()
    deadline = time.monotonic() + 60.0
    while not any(base_folder().glob("*/run.json")) or any(run.alive for run in runs()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert all(each.safe for each in recover_dead_runs())
    assert_complete(begun, "stopped because the supervisor died")
    assert read(begun.outputs[1]).samples.command[-1] == 0.0


def test_a_file_that_is_lost_ends_the_run_and_keeps_what_is_in_memory(begun):
    begun.outputs[1].unlink()
    code, printed = begun.ended()
    assert code == 3
    assert "run.y.mcap" in printed["reason"]
    x = read(begun.outputs[0])
    assert (x.dropped, x.end["code"]) == (0, "stopped")
    (run,) = runs()
    assert run.kept


FULL = """
import os, sys
from io import FileIO
from hilctl.recording import writer
from hilctl import cli

class Full(FileIO):
    def write(self, data):
        if self.tell() > 100_000 and ".y." in os.readlink(f"/proc/self/fd/{self.fileno()}"):
            raise OSError(28, "No space left on device")
        return super().write(data)

class Pending(writer.PendingFile):
    def __init__(self, raw, **options):
        super().__init__(Full(os.dup(raw.fileno()), "wb"), **options)

writer.PendingFile = Pending
sys.argv = ["hilctl", *sys.argv[1:]]
sys.exit(cli.main())
"""


def test_a_full_disk_of_one_axis_loses_nothing(tmp_path):
    """The run ends, and the next command completes the recording from memory."""
    run = StartedRun(tmp_path, EXPERIMENT, program=("-c", FULL))
    run.outputs = [tmp_path / f"run.{name}.mcap" for name in "xy"]
    code, printed = run.ended()
    assert code == 3
    assert "No space left" in printed["reason"]
    assert not any(each.kept for each in recover_dead_runs())
    assert_complete(run, "stopped because the recording cannot be written")


def test_status_marks_and_stop(begun):
    (run,) = runs()
    status = status_of(run)
    assert status["axes"] == {
        name: str(path) for name, path in zip("xy", begun.outputs, strict=True)
    }
    assert (status["state"], status["missing_samples"]) == ("running", 0)
    both = set_run(run, gain=0.5, over_s=0.1)
    assert both["references"]["y"]["gain"] == 0.5
    alone = set_run(run, axes={"y": {"gain": 0.25}}, over_s=0.1)
    with pytest.raises(InputError, match="'z'"):
        set_run(run, axes={"z": {"gain": 1.0}})
    gains = [each["gain"] for each in status_of(run)["references"].values()]
    assert gains == [0.5, 0.25]
    while status_of(run)["sample"] <= alone["begins_at_sample"]:
        time.sleep(0.01)
    mark_run(run, "tapped")
    (stopped,) = stop_runs([run], 60.0)
    assert stopped["ended"]
    begun.ended()
    x, y = ([*read(path).events] for path in begun.outputs)
    assert "mark" in {event.code for event in x} & {event.code for event in y}
    at_x, at_y = ([each.sample for each in events if each.code == "tuned"] for events in (x, y))
    assert at_y == [*at_x, at_y[1]]
    assert at_y[0] >= both["begins_at_sample"]
    assert at_y[1] >= alone["begins_at_sample"]
    assert_complete(begun, "stopped")
