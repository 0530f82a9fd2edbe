"""Runs whose reference does not fit in memory: hours of it, of which a test sees some seconds."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.base.errors import ConfigError
from hilctl.recording.reader import read
from hilctl.run.run_folder import runs
from hilctl.run.start import checked_experiment
from tests.faults.test_daemon import await_state, hilctl, stop_all

CONFIGS = Path(__file__).parents[2] / "configs"
WINDOW_S = 5.3


@pytest.fixture
def experiment(tmp_path):
    """Write an experiment of ten hours at a block that a busy machine keeps."""
    made = yaml.safe_load((CONFIGS / "demo.yaml").read_text(encoding="utf-8"))
    made |= {"sample_rate_hz": 50000, "block": 500, "recording": {"flush_s": 0.2, "ring_s": 30.0}}
    made["timing"] = {"max_late_s": 30.0, "hang_s": 30.0}
    made["waveform"] = {
        "kind": "sine", "unit": "um", "amplitude": 30.0, "frequency_hz": 20.0,
        "duration_s": 36000.0, "soft_start_s": 0.2,
    }  # fmt: skip
    made["compensator"]["model"] = str(CONFIGS / "models" / "terfenol_staged.yaml")
    path = tmp_path / "experiment.yaml"
    path.write_text(yaml.safe_dump(made), encoding="utf-8")
    yield path
    stop_all()


def started(experiment):
    return Path(
        hilctl("run", experiment, "--output", experiment.parent / "run.mcap", "--detach")[
            "recording"
        ]
    )


def await_sample(sample, timeout_s=120.0):
    until = time.monotonic() + timeout_s
    while hilctl("status")["runs"][0]["recorded_samples"] < sample:
        assert time.monotonic() < until
        time.sleep(0.1)


def test_ten_hours_run_are_changed_and_replayed(experiment):
    """Each sample is the formula's, round and round the window; a change is answered."""
    recording = started(experiment)
    await_state("running")
    assert hilctl("set", "gain=0.5", "--over", "0.5")["gain"] == 0.5
    assert "must stay within" in hilctl("set", "gain=9", code=2)
    hilctl("set", "gain=1", "--over", "0.2")
    await_sample(2.5 * WINDOW_S * 50_000)
    stop_all()
    found = read(recording)
    assert replay(found).identical
    assert (found.dropped, found.end["code"]) == (0, "stopped")
    checked = checked_experiment(experiment, [])
    n = int(np.isfinite(found.samples.reference_um).sum())
    assert n > 2.5 * WINDOW_S * 50_000
    wanted = checked.reference.values[0:n]
    tail = slice(n - 200_000, n)
    assert found.samples.reference_um[tail].tolist() == wanted[tail].tolist()


def test_a_reference_that_comes_no_more_ends_the_run(experiment):
    """Its process is held: the run comes to the end of the window, and ramps to the safe value."""
    recording = started(experiment)
    await_state("running")
    (run,) = runs()
    supervisor = run.card.supervisor
    children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
    forked = [
        int(child)
        for child in children
        if b"loop_process" not in Path(f"/proc/{child}/cmdline").read_bytes()
    ]
    assert forked
    for each in forked:
        os.kill(each, signal.SIGSTOP)
    until = time.monotonic() + 120.0
    while runs():
        assert time.monotonic() < until
        time.sleep(0.1)
    found = read(recording)
    assert "the reference was not worked out in time at sample" in found.end["reason"]
    assert (found.end["code"], found.end["output_safe"], found.dropped) == ("fault", "true", 0)
    assert found.samples.command[-1] == 0.0


def test_what_a_long_one_would_leave_is_refused_before(experiment):
    with pytest.raises(ConfigError, match="must stay within"):
        checked_experiment(experiment, ["waveform.amplitude=60.0"])
