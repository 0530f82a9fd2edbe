"""Characterisation of simulated rigs: from limits to a model, also after a kill."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hilctl.analysis.report import summarize
from hilctl.lab.studies.characterise.characterisation_runner import (
    CharacterisationRunner,
)
from hilctl.lab.studies.study import StudyHost
from hilctl.recording.reader import read
from hilctl.run.start import checked_run, unpaced
from hilctl.run.unpaced import run_unpaced

CONFIGS = Path(__file__).parents[2] / "configs"
RIG = CONFIGS / "terfenol_sine_6a.yaml"
FAST = StudyHost(run=unpaced, real_time=False)


def characterised(path, settings, folder, output):
    campaign = CharacterisationRunner(path, settings, folder, None, FAST)
    assert campaign.plan.seconds < 300.0
    return campaign.characterise(output)


@pytest.mark.parametrize(("physics", "within_percent"), [
    pytest.param("terfenol", 2.0, marks=pytest.mark.long),
    pytest.param("diffusion", 2.5, marks=pytest.mark.long),
    pytest.param("jiles_atherton", 8.0, marks=pytest.mark.long),
])  # fmt: skip
def test_a_rig_of_any_physics_gets_a_model(tmp_path, other_rigs, physics, within_percent):
    model = tmp_path / "model.yaml"
    other = [f"device.kind=simulated_{physics}"]
    found = characterised(RIG, other, tmp_path / "runs", model)
    assert found.problem == ""
    assert found.held_out[0].peak_percent < within_percent
    assert found.measured.small.natural_hz == pytest.approx(2292.0, rel=0.05)
    settings = [
        *other, f"compensator.model={model}", "waveform.amplitude=30.0", "waveform.offset=-5.0",
        "waveform.frequency_hz=50.0", "waveform.duration_s=0.9", "device.seed=99",
    ]  # fmt: skip
    run = run_unpaced(checked_run(RIG, settings), tmp_path / "run.mcap")
    assert summarize(read(run.path)).peak_error_percent < within_percent


@pytest.mark.long
def test_a_piezo_that_begins_at_0_v_gets_a_model(tmp_path):
    """Its range is that of its sensor, 38 um."""
    found = characterised(
        CONFIGS / "piezo_sine.yaml", [], tmp_path / "runs", tmp_path / "model.yaml"
    )
    assert found.problem == ""
    assert found.held_out[0].peak_percent < 3.0
    assert 30.0 < max(loop.high_um for loop in found.measured.growing) < 38.0


@pytest.mark.parametrize(("setting", "code"), [
    pytest.param("device.vary={strain: 0.5, resonance: 0.5}", "", marks=pytest.mark.long),
    ("device.fault={kind: sensor_frozen, at_sample: 0}", "no_reaction"),
    pytest.param("device.fault={kind: sensor_inverted, at_sample: 0}", "wrong_polarity",
        marks=pytest.mark.long),
    ("device.magnet=false", "no_bias"),
    ("device.load_kg=90.0", "resonance"),
])  # fmt: skip
def test_problems_of_a_rig_are_named(tmp_path, setting, code):
    quick = ["sample_rate_hz=20000", "block=20"]
    campaign = CharacterisationRunner(RIG, [*quick, setting], tmp_path, None, FAST)
    if not code:  # a weak one, but nothing is wrong with it
        campaign = CharacterisationRunner(RIG, [*quick, setting], tmp_path, 40.0, FAST)
    found = campaign.characterise(tmp_path / "model.yaml")
    assert found.problem_code == code
    assert (tmp_path / "model.yaml").exists() is (code == "")


def test_a_campaign_that_is_killed_loses_one_step(tmp_path):
    words = [
        sys.executable, "-m", "hilctl", "characterise", str(RIG), "--output",
        str(tmp_path / "model.yaml"), "--folder", str(tmp_path / "runs"),
        "--set", "sample_rate_hz=5000", "--set", "block=50", "--set", "recording.flush_s=0.1",
    ]  # fmt: skip
    third = tmp_path / "runs" / "05-response-1.mcap"

    def begun():
        return third.exists() and third.stat().st_size > 20_000  # samples, not the header alone

    def until(ready):
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ)
        deadline = time.monotonic() + 240.0
        while not ready() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        assert process.poll() is None, "it ended before it could be stopped"
        return process

    process = until(third.exists)
    process.kill()
    process.communicate()
    kept = {each.name: each.stat().st_mtime_ns for each in (tmp_path / "runs").glob("0[12]-*")}
    assert len(kept) == 2
    assert not begun()
    process = until(begun)
    process.send_signal(signal.SIGINT)
    shown, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGINT
    assert len(re.findall(r"\bdone\b", shown)) == 2
    for name, changed in kept.items():
        assert (tmp_path / "runs" / name).stat().st_mtime_ns == changed
