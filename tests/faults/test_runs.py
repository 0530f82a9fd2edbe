"""Complete runs with faults, as a user starts them: one safe ramp, nothing lost."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.base.samples import Flag
from hilctl.recording.reader import read
from hilctl.run.control.client import status_of
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.run_folder import base_folder, runs
from hilctl.run.start import checked_run
from hilctl.run.supervisor import Supervisor
from tests.faults.conftest import StartedRun, simulated, sine

MODELS = Path(__file__).parents[2] / "configs" / "models"

EXPERIMENT = simulated(
    "fault_test", 20000, sine(20.0, 30.0), 5000.0, block=20, recording={"flush_s": 0.1}
)


def experiment(folder, **changes):
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({**EXPERIMENT, **changes}), encoding="utf-8")
    return path


def short(seconds):
    return sine(20.0, seconds)


def started(folder, **changes):
    return StartedRun(folder, {**EXPERIMENT, **changes})


def assert_good_way_out(run):
    """Assert that the recording is complete, ends at the safe value by the ramp, and replays."""
    recording = read(run.output)
    samples = recording.samples
    assert np.array_equal(samples.index, np.arange(samples.index.size))
    assert recording.dropped == 0
    assert recording.end["recorded_samples"] == str(samples.index.size)
    assert recording.end["output_safe"] == "true"
    assert samples.command[-1] == 0.0
    assert samples.flags[-1] & Flag.RAMP
    steps = np.abs(np.diff(samples.command))
    assert steps.max() <= 5000.0 / 20000 * (1 + 1e-9)
    ramp = (samples.flags & Flag.RAMP.value) != 0
    assert steps[ramp[1:]].max() <= 5.0 / 0.2 / 20000 * (1 + 1e-9)
    assert replay(recording).identical
    return recording


@pytest.mark.parametrize(("number", "code", "words"), [
    (signal.SIGTERM, 143, "stopped by SIGTERM"),
    (signal.SIGHUP, 129, "stopped by SIGHUP"),
])  # fmt: skip
def test_signals_ramp_down(tmp_path, number, code, words):
    """The run ends by its ramp and leaves a complete recording."""
    run = started(tmp_path)
    run.await_size()
    run.process.send_signal(number)
    returned, printed = run.ended()
    assert returned == code
    assert printed["code"] == "stopped"
    assert words in printed["reason"]
    recording = assert_good_way_out(run)
    assert recording.events[-1].code == "run_ended"
    assert words in recording.events[-1].text


def test_further_signals_do_not_skip_the_ramp(tmp_path):
    """The first signal determines the exit code and the reason."""
    run = started(tmp_path)
    run.await_size()
    for number in (signal.SIGINT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        run.process.send_signal(number)
        time.sleep(0.02)
    returned, printed = run.ended()
    assert (returned, printed["code"]) == (130, "stopped")
    assert "stopped by Ctrl-C" in assert_good_way_out(run).events[-1].text


@pytest.mark.parametrize(
    ("kind", "code", "words"),
    [
        ("sensor_nan", "sensor_invalid", "displacement at sample 9000"),
        ("sensor_jump", "stroke", "stroke limits -60 to 60 µm"),
    ],
)
def test_bad_sensor_ramps_down(tmp_path, kind, code, words):
    """An invalid reading ends the run by its ramp."""
    device = {**EXPERIMENT["device"], "fault": {"kind": kind, "at_sample": 9000}}
    run = started(tmp_path, device=device)
    returned, printed = run.ended()
    assert returned == 3
    assert printed["code"] == "fault"
    assert words in printed["reason"]
    recording = assert_good_way_out(run)
    first = int(np.argmax((recording.samples.flags & Flag.SENSOR_INVALID.value) != 0))
    assert first >= 9000
    trip = recording.events[0]
    assert (trip.code, trip.sample, trip.level) == (code, first, "error")
    assert trip.before.index.tolist() == list(range(first - 49, first + 1))
    part = recording.samples.part(first - 49, first + 1)
    assert np.array_equal(trip.before.command, part.command)
    assert np.array_equal(trip.before.displacement_um, part.displacement_um, equal_nan=True)


@pytest.mark.parametrize("kind", ["no_answer", "refused"])
def test_device_that_fails_is_made_safe(tmp_path, kind):
    """The safe value is set directly, and every earlier sample is in the file."""
    device = {**EXPERIMENT["device"], "fault": {"kind": kind, "at_sample": 9000}}
    run = started(tmp_path, device=device)
    returned, printed = run.ended()
    assert returned == 3
    assert "simulated_terfenol" in printed["reason"]
    assert printed["output_safe"] is True
    recording = read(run.output)
    assert recording.samples.index.size == 9020
    unanswered = (recording.samples.flags & Flag.UNANSWERED.value) != 0
    assert np.flatnonzero(unanswered).tolist() == list(range(9000, 9020))
    assert recording.end["code"] == "fault"
    assert [event.code for event in recording.events] == ["device_lost", "run_ended"]


def test_killed_loop_is_noticed(tmp_path):
    """The supervisor drains the ring, makes the device safe, and closes the recording."""
    run = started(tmp_path)
    run.await_size()
    os.kill(run.loop_pid(), signal.SIGKILL)
    returned, printed = run.ended()
    assert returned == 3
    assert "the loop process died: killed by SIGKILL" in printed["reason"]
    recording = read(run.output)
    assert recording.end["code"] == "fault"
    assert np.array_equal(recording.samples.index, np.arange(recording.samples.index.size))
    assert replay(recording).identical


def test_loop_ramps_down_if_the_supervisor_is_killed(tmp_path):
    """The loop ramps down and leaves when its supervisor dies; the file can be read."""
    run = started(tmp_path)
    run.await_size()
    loop = run.loop_pid()
    run.process.kill()
    run.process.communicate()
    deadline = time.monotonic() + 20.0
    while Path(f"/proc/{loop}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    (orphan,) = recover_dead_runs()
    assert orphan.safe
    assert orphan.recording == run.output
    recording = assert_good_way_out(run)
    assert recording.samples.index.size > 1000
    assert recording.end["reason"] == "stopped because the supervisor died"
    assert recover_dead_runs() == []


def test_run_leaves_nothing_in_memory(tmp_path):
    """The ring and the reference are gone after a run."""
    run = started(tmp_path, waveform=short(0.5))
    assert run.ended()[0] == 0
    assert list(base_folder().iterdir()) == []
    assert_good_way_out(run)


def test_model_exchanged_after_the_check_changes_nothing(tmp_path):
    """The checked files are used and recorded."""
    model = tmp_path / "model.yaml"
    model.write_text((MODELS / "terfenol_omega.yaml").read_text())
    waveform = {"kind": "sine", "unit": "um", "amplitude": 8.0, "frequency_hz": 20.0}
    waveform |= {"duration_s": 0.1, "soft_start_s": 0.05}
    compensator = {"model": model.name}
    path = experiment(tmp_path, waveform=waveform, compensator=compensator)
    checked = checked_run(path, ())
    model.write_text((MODELS / "terfenol_rdpi.yaml").read_text())
    output = tmp_path / "run.mcap"
    result = Supervisor(checked, output, overwrite=False, on_progress=lambda _: None).run()
    assert (result.code, result.missing) == ("completed", 0)
    assert replay(read(output)).identical


def supervised(folder, on_progress=lambda _: None, **changes):
    """Run an experiment in this process; return how it ended, and its recording."""
    checked = checked_run(experiment(folder, **changes), ())
    output = folder / "run.mcap"
    result = Supervisor(checked, output, overwrite=False, on_progress=on_progress).run()
    return result, read(output)


def test_the_longest_name_and_folder_are_no_error_after_the_start(tmp_path, monkeypatch):
    """The kernel's limit for the path of a socket is 107 bytes; requests work nevertheless."""
    monkeypatch.setenv("HILCTL_RUNS", str(tmp_path / ("deep" * 20)))
    states = []

    def ask_status(progress):
        states.extend(status_of(each)["state"] for each in runs() if not states)

    result, recording = supervised(tmp_path, ask_status, name="n" * 80, waveform=short(0.5))
    assert (result.code, recording.dropped) == ("completed", 0)
    assert set(states) <= {"running", "stopping", "closing"}
    assert states


def test_failing_supervisor_ends_the_run_by_its_ramp(tmp_path, monkeypatch):
    """Output, ring and recording are still served; no sample is lost."""
    calls = []

    def alive(self):
        calls.append(self)
        if len(calls) == 30:
            raise ZeroDivisionError("a bug")

    monkeypatch.setattr("hilctl.run.supervisor.SystemdNotifier.alive", alive)
    result, recording = supervised(tmp_path)
    assert result.reason.endswith("ZeroDivisionError: a bug")
    assert (result.code, result.safe, result.missing) == ("fault", True, 0)
    assert recording.samples.index.size == result.samples > 1000
    assert recording.samples.command[-1] == 0.0
    assert "supervisor_broke" in [event.code for event in recording.events]
    assert replay(recording).identical


@pytest.mark.parametrize("how", ["raises", "stands still"])
def test_failing_display_does_not_end_the_run(tmp_path, how):
    """A blocked terminal delays nothing."""
    released = threading.Event()

    def show(progress):
        if how == "raises":
            raise BrokenPipeError(32, "Broken pipe")
        released.wait(60.0)

    try:
        result, recording = supervised(tmp_path, show, waveform=short(1.0))
    finally:
        released.set()
    assert (result.code, result.missing) == ("completed", 0)
    said = [event.code for event in recording.events]
    assert said == (["progress_failed"] if how == "raises" else []) + ["run_ended"]


@pytest.mark.parametrize("how", ["deleted", "renamed", "truncated"])
@pytest.mark.parametrize("on_failure", ["stop", "go_on"])
def test_lost_recording_is_a_fault(tmp_path, how, on_failure):
    """The run ramps down or continues; the samples in the ring are kept."""
    output, moved = tmp_path / "run.mcap", tmp_path / "moved.mcap"
    done = []

    def take_away(progress):
        if done or output.stat().st_size < 100_000:
            return
        done.append(how)
        if how == "deleted":
            output.unlink()
        elif how == "renamed":
            output.rename(moved)
        else:
            os.truncate(output, 0)

    changes = {"waveform": short(3.0)}
    changes["recording"] = {"flush_s": 0.1, "ring_s": 2.0, "on_failure": on_failure}
    checked = checked_run(experiment(tmp_path, **changes), ())
    result = Supervisor(checked, output, overwrite=False, on_progress=take_away).run()
    assert done
    assert (result.code, result.output_state) == ("fault", "confirmed")
    assert ("truncated" if how == "truncated" else "deleted or renamed") in result.reason
    assert result.reason.startswith("waveform completed") == (on_failure == "go_on")
    (left,) = runs()
    assert str(left.path) in result.reason
    if how == "renamed":
        moved.rename(output)
    (orphan,) = recover_dead_runs()
    assert (orphan.kept is None) == (how == "renamed")
    if how == "renamed" and on_failure == "stop":
        recording = read(output)
        assert recording.dropped == 0
        assert replay(recording).identical
