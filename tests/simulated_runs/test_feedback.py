"""Feedback around the compensator on the simulated rig, sample by sample through complete runs."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilctl import api
from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.base.samples import Flag
from hilctl.recording.reader import read
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced

CONFIG = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
BASE = ("sample_rate_hz=5000", "block=1", "waveform.frequency_hz=5.0", "waveform.duration_s=1.0")
OMEGA = "compensator.model=models/terfenol_omega.yaml"
STAGED = "compensator.model=models/terfenol_staged.yaml"
FEEDBACK = (
    "feedback={limit_um: 10.0, bandwidth_hz: 80.0, resonance_hz: 2300.0, damping_ratio: 0.12}"
)
INTEGRAL = "feedback={kind: integral, bandwidth_hz: 5.0, limit_um: 10.0}"
DRIFT = "device.drift={um: 6.0, tau_s: 0.3}"


@pytest.fixture
def run(tmp_path):
    """Run the shipped experiment with settings; return how it ended and its recording."""

    def run(*settings):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        return run_unpaced(checked_run(CONFIG, [*BASE, *settings]), path), read(path)

    return run


def rms_error_percent(recording):
    (segment,) = summarize(recording).segments
    return segment.rms_error_percent


@pytest.mark.parametrize(
    ("model", "wrong"),
    [(OMEGA, DRIFT), (STAGED, "device.vary={strain: 1.1}")],
    ids=["drift", "strain"],
)
def test_feedback_removes_model_errors(run, model, wrong):
    plain, plainly_recorded = run(model, wrong)
    result, recording = run(model, wrong, FEEDBACK)
    assert plain.code == result.code == "completed"
    assert rms_error_percent(recording) < 0.2 * rms_error_percent(plainly_recorded)
    assert replay(recording).identical


def test_an_integrator_takes_out_the_offset_of_small_loops(run):
    blocks = (STAGED, "sample_rate_hz=50000", "block=50", "waveform.frequency_hz=10.0")
    quarter = ("waveform.amplitude=10.2", "waveform.offset=0.0", "waveform.duration_s=2.0")
    _, plain = run(*blocks, *quarter, DRIFT)
    _, recording = run(*blocks, *quarter, DRIFT, INTEGRAL)
    (before,), (after,) = summarize(plain).segments, summarize(recording).segments
    assert before.peak_error_percent > 20.0
    assert after.peak_error_percent < 1.5
    assert replay(recording).identical


SMALL = (
    "waveform={kind: multisine, unit: um, amplitude: 0.7, first_hz: 5.0, last_hz: 2400.0,"
    " step_hz: 20.0, duration_s: 3.0, soft_start_s: 0.2, soft_end_s: 0.2}"
)


@pytest.mark.slow
def test_a_tuned_loop_has_its_margins_in_operation(run, tmp_path):
    """The proposal is accepted, and a run with it shows the same margins and little error."""
    _, plain = run(STAGED, SMALL)
    design = api.tune(plain.path, tmp_path / "response.yaml", tmp_path / "tune.html")
    assert design.recorded is None
    feedback = f"feedback={json.dumps(design.feedback)}"
    _, small = run(STAGED, SMALL, DRIFT, feedback)
    found = api.tune(small.path).recorded
    assert found.gain_margin_db > 6.0
    assert found.phase_margin_deg == pytest.approx(design.proposed.phase_margin_deg, abs=3.0)
    _, recording = run(STAGED, DRIFT, "waveform.frequency_hz=20.0", feedback)
    assert rms_error_percent(recording) < 0.3


def test_the_input_is_recorded_with_its_correction(run):
    _, recording = run(OMEGA, DRIFT, FEEDBACK.replace("limit_um: 10.0", "limit_um: 2.0"))
    samples = recording.samples
    ramp = (samples.flags & Flag.RAMP) != 0
    correction_um = (samples.input_um - samples.reference_um)[~ramp]
    assert np.abs(correction_um).max() == pytest.approx(2.0, abs=1e-9)
    assert np.isnan(samples.input_um[ramp]).all()


def test_a_lost_sensor_ends_the_run_by_its_interlock(run):
    lost = "device.fault={kind: sensor_nan, at_sample: 1500}"
    result, recording = run(OMEGA, FEEDBACK, lost)
    samples = recording.samples
    assert result.code == "fault"
    assert np.isfinite(samples.command).all()
    ramp = (samples.flags & Flag.RAMP) != 0
    assert samples.index[ramp][0] == 1501
    assert np.isfinite(samples.input_um[~ramp]).all()


@pytest.mark.parametrize(
    "model", [pytest.param(OMEGA, marks=pytest.mark.long), STAGED], ids=["omega", "staged"]
)
def test_a_sensor_of_the_wrong_sign_ends_the_run(run, model):
    inverted = "device.fault={kind: sensor_inverted, at_sample: 0}"
    result, recording = run(model, FEEDBACK, inverted)
    assert (result.code, result.safe) == ("fault", True)
    assert "the sign of" in result.reason
    (event,) = (each for each in recording.events if each.level == "error" and each.before)
    assert event.code == "feedback_sign"
    assert event.sample < 0.5 * recording.sample_rate_hz
    assert run(model, FEEDBACK)[0].code == "completed"
