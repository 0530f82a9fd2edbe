"""A compensated run through the buffers of an emulated LabJack T7, as a user types it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hilctl.recording.reader import read

CONFIG = Path(__file__).parents[2] / "configs" / "modbus_labjack_t7_stream.yaml"


def start(*words):
    command = [sys.executable, "-m", "hilctl.cli", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def port():
    """The port of ``hilctl emulate labjack_t7``."""
    emulator = start("emulate", "labjack_t7")
    yield emulator.stdout.readline().split()[-1].rpartition(":")[2]
    emulator.terminate()
    emulator.communicate(timeout=30)
    assert emulator.returncode == 0


def test_every_sample_is_put_out_and_answered(port, tmp_path):
    """At a rate that a busy machine keeps: none is missing, and the loop follows its reference."""
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
