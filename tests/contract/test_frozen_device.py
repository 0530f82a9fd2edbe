"""A device written for version 0.2.0: it keeps the contract, and runs, unchanged."""

import hashlib
import json
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest
import yaml

from hilctl import api
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment.devices import made_device
from hilctl_drivers.contract import *  # noqa: F403
from tests import device_packages

SHA256 = "05e59c5b42846de4e5c027a01f2c1928ac4987f2150b9b06aa4fe6c2b2f014d4"
EXPERIMENT = {
    "name": "frozen",
    "device": {"kind": "frozen_stage", "watchdog_s": 1.0},
    "sample_rate_hz": 200,
    "waveform": {"kind": "sine", "unit": "V", "amplitude": 20.0, "offset": 50.0,
                 "frequency_hz": 4.0, "duration_s": 1.0, "soft_start_s": 0.25},
    "compensator": "none",
    "limits": {"drive_v": [0.0, 90.0], "slew_v_per_s": 2000.0, "stroke_um": [-0.5, 40.0],
               "measured_deviation_v": 1.0, "deviation_s": 0.1},
}  # fmt: skip


@pytest.fixture
def package(monkeypatch):
    device_packages.installed_here("frozen_device", monkeypatch)
    return import_module("frozen_device.stage")


@pytest.fixture(params=["by itself", "of an experiment"])
def new_device(package, request, tmp_path):
    if request.param == "by itself":
        return lambda: package.Stage(package.StageOptions())
    document = Document("x.yaml", "device: {kind: frozen_stage}")
    return lambda: made_device(document, tmp_path, TextFiles({}))


@pytest.fixture
def experiment(tmp_path):
    path = tmp_path / "frozen.yaml"
    path.write_text(yaml.safe_dump(EXPERIMENT), encoding="utf-8")
    return path


def test_it_was_not_changed():
    source = device_packages.DATA / "frozen_device" / "frozen_device" / "stage.py"
    assert hashlib.sha256(source.read_bytes()).hexdigest() == SHA256


@pytest.mark.parametrize("confirms", [True, False])
def test_it_runs_without_real_time(package, experiment, tmp_path, confirms):
    settings = {"device.confirms": confirms}
    run = api.run(experiment, tmp_path / "run.mcap", settings=settings, fast=True)
    assert (run.code, run.safe) == ("completed", confirms)
    recording = api.read(run.path).recording
    assert recording.run["device.serial_number"] == "17"
    assert np.ptp(recording.samples.displacement_um[100:200]) == pytest.approx(16.0, rel=0.05)


@pytest.mark.slow
def test_it_runs_in_real_time(experiment, tmp_path):
    environment = device_packages.installed("frozen_device", tmp_path / "site")
    recording = tmp_path / "run.mcap"
    for words in (
        ["run", experiment, "--output", recording],
        ["safe", experiment],
        ["devices", "probe", experiment],
        ["devices", "show", "frozen_stage"],
    ):
        command = [sys.executable, "-P", "-m", "hilctl", *map(str, words), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)
    assert api.read(recording).recording.end["code"] == "completed"
