"""A third-party device package: installed, listed and run with public names only."""

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from tests import device_packages

SOURCE = Path(__file__).parents[1] / "data" / "own_device"
PUBLIC = {"Device", "DeviceError", "DeviceInfo", "DeviceOptions"}
EXPERIMENT = {
    "name": "own_device",
    "device": {"kind": "spring", "um_per_a": 20.0},
    "sample_rate_hz": 200,
    "waveform": {"kind": "sine", "unit": "A", "amplitude": 2.0, "frequency_hz": 4.0,
                 "duration_s": 0.5, "soft_start_s": 0.1},
    "compensator": "none",
    "limits": {"peak_current_a": 3.0, "slew_a_per_s": 500.0, "stroke_um": [-90.0, 90.0]},
    "safe": {"value": 0.0, "ramp_s": 0.1},
}  # fmt: skip


@pytest.fixture
def installed(tmp_path):
    return device_packages.installed("own_device", tmp_path / "site")


def hilctl(environment, *words):
    command = [sys.executable, "-m", "hilctl", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def experiment(folder, **device):
    path = folder / "own.yaml"
    changed = {**EXPERIMENT, "device": {**EXPERIMENT["device"], **device}}
    path.write_text(yaml.safe_dump(changed), encoding="utf-8")
    return path


@pytest.mark.slow
def test_is_listed_and_in_the_schema(installed):
    devices = json.loads(hilctl(installed, "devices", "--json").stdout)["devices"]
    assert devices["spring"] == "own_device.spring:Spring"
    schema = json.loads(hilctl(installed, "schema").stdout)
    assert "um_per_a" in schema["$defs"]["device_spring"]["properties"]


@pytest.mark.slow
def test_is_run(installed, tmp_path):
    output = tmp_path / "own.mcap"
    done = hilctl(installed, "run", experiment(tmp_path), "--output", output, "--json")
    assert done.returncode == 0, done.stderr
    recording = read(output)
    assert (recording.run["device"], recording.run["simulated"]) == ("spring", "true")
    assert recording.run["device.um_per_a"] == "20"
    assert np.abs(recording.samples.displacement_um).max() == pytest.approx(40.0, rel=0.05)
    assert replay(recording).identical


@pytest.mark.slow
@pytest.mark.long
def test_is_characterised(installed, tmp_path):
    model = tmp_path / "model.yaml"
    words = ("characterise", experiment(tmp_path), "--output", model, "--fast", "--json")
    done = hilctl(installed, *words, "--set", "compensator={model: model.yaml}")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["measured"]["small"]["gain_um"] == pytest.approx(20.0, rel=0.02)
    assert found["held_out"][0]["peak_percent"] < 2.0
    assert model.is_file()
    assert model.with_suffix(".html").is_file()


@pytest.mark.slow
def test_its_options_are_checked_like_any_other(installed, tmp_path):
    done = hilctl(installed, "check", experiment(tmp_path, um_per_a=-1.0, um_per_b=2.0))
    assert done.returncode == 2
    mistake, unknown = (
        next(line for line in done.stderr.splitlines() if f"device.um_per_{key}: " in line)
        for key in "ab"
    )
    assert "-1.0" in mistake
    assert "um_per_a" in unknown
    assert "own.yaml:" in done.stderr


def test_it_needs_the_public_names_only():
    found = set()
    for path in (SOURCE / "own_device").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("hilctl"):
                found |= {f"{node.module}.{each.name}" for each in node.names}
            elif isinstance(node, ast.Import):
                assert not any(each.name.startswith("hilctl") for each in node.names)
    assert found == {f"hilctl.base.{name}" for name in PUBLIC}


def test_make_safe_moves_the_spring(monkeypatch):
    monkeypatch.syspath_prepend(SOURCE)
    spring = importlib.import_module("own_device.spring")
    device = spring.Spring(spring.SpringOptions(um_per_a=20.0))
    block, displacement_um, measured = np.full(50, 3.0), np.empty(50), np.empty(50)
    for safe in (-1.0, 0.5):
        device.open(1000.0, 50)
        device.exchange(0, block, displacement_um, measured)
        device.make_safe(safe)
        device.close()
        device.make_safe(safe)
        device.open(1000.0, 50)
        assert device.output() == safe
        device.exchange(0, block, displacement_um, measured)
        assert displacement_um[0] == pytest.approx(20.0 * safe)
    device.close()
    device.make_safe(0.0)
    device.open(1000.0, 50)
    assert device.output() == 0.0


CONTRACT = """
import pytest
from hilctl_drivers.contract import *
from own_device.spring import Spring, SpringOptions

class Stuck(Spring):
    def make_safe(self, command):
        pass

@pytest.fixture
def new_device():
    return lambda: {kind}(SpringOptions())
"""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "code"), [("Spring", 0), ("Stuck", 1)])
def test_its_package_runs_the_contract(installed, tmp_path, kind, code):
    """The package runs the contract as in drivers/README.md, and a broken device fails."""
    path = tmp_path / "test_spring.py"
    path.write_text(CONTRACT.format(kind=kind), encoding="utf-8")
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", path]
    ran = subprocess.run(words, capture_output=True, text=True, env=installed, cwd=tmp_path)
    assert ran.returncode == code, ran.stdout
    assert ("make_safe_works_open_or_closed" in ran.stdout) == bool(code)
    assert "passed" in ran.stdout
