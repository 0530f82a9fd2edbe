"""A compensated run through the buffers of an emulated LabJack T7, as a user types it."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.base.events import OFFSET
from hilctl.recording.reader import read
from tests.commands import typed

CONFIG = Path(__file__).parents[2] / "configs" / "modbus_labjack_t7_stream.yaml"


def start(*words):
    pipe = subprocess.PIPE
    return subprocess.Popen(typed(*words), stdout=pipe, stderr=pipe, text=True)


@pytest.fixture
def port():
    """The port of ``hilctl emulate labjack_t7``."""
    emulator = start("emulate", "labjack_t7")
    yield emulator.stdout.readline().split()[-1].rpartition(":")[2]
    emulator.terminate()
    emulator.communicate(timeout=30)
    assert emulator.returncode == 0


def ran(port, path, *more):
    """Run the experiment on the emulated device; return its result and what it said."""
    rate = (
        "sample_rate_hz=2500",
        "waveform.duration_s=3.0",
        "timing.max_late_s=30.0",
        "device.timeout_s=1.0",
    )
    changes = [f"device.tcp_port={port}", *rate, *more]
    settings = [word for change in changes for word in ("--set", change)]
    run = start("run", CONFIG, *settings, "--output", path, "--json")
    out, err = run.communicate(timeout=120)
    assert run.returncode == 0, out + err
    return json.loads(out), err


def test_every_sample_is_put_out_and_answered(port, tmp_path):
    path = tmp_path / "run.mcap"
    changes = {"device.tcp_port": port, "sample_rate_hz": 10000, "waveform.duration_s": 2.0}
    settings = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    ran = start("run", CONFIG, *settings, "--output", path, "--json")
    out, err = ran.communicate(timeout=120)
    assert ran.returncode == 0, err
    result = json.loads(out)
    assert result["code"] == "completed"
    assert result["dropped"] == 0
    samples = read(path).samples
    assert np.isfinite(samples.displacement_um).all()
    assert (np.diff(samples.index) == 1).all()
    assert np.count_nonzero(np.isfinite(samples.reference_um)) == 20_000
    error_um = (samples.displacement_um - samples.reference_um)[6_000:16_000]
    assert np.sqrt(np.mean(error_um**2)) < 2.5


def test_an_integrator_and_history_through_a_fifo(port, tmp_path):
    integral = "feedback={kind: integral, bandwidth_hz: 0.012, limit_um: 15.0}"
    before = ("condition={cycles: 3}", "compensator.offset=measured", "device.sensor.offset_um=2.0")
    _, said = ran(port, tmp_path / "a.mcap", *before, integral)
    assert "its condition leaves" in said
    recording = read(tmp_path / "a.mcap")
    assert replay(recording).identical
    samples = recording.samples
    correction_um = samples.input_um - samples.reference_um
    assert np.nanmax(np.abs(correction_um)) > 0.01
    (event,) = (each for each in recording.events if each.code == OFFSET)
    assert event.values["offset_um"] == pytest.approx(2.0, abs=1.0)
    _, said = ran(port, tmp_path / "b.mcap")
    assert f"begins where {tmp_path}/a.mcap left" in said
    assert read(tmp_path / "b.mcap").run["initial_state_run_id"] == recording.run["run_id"]
