"""Identification of crosstalk: its runs, its rules, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, InputError, RunError
from hilctl.experiment.load import load_axes
from hilctl.lab.response.frequency_response import Lines
from hilctl.lab.studies.couple import CouplingStudy
from hilctl.lab.studies.study import StudyRun

STAGE = Path(__file__).parents[4] / "configs" / "stage_xy.yaml"
HZ = np.arange(1, 257) * 1.5625


def lines(response, noise=1e-6):
    size = HZ.size
    values = np.broadcast_to(np.asarray(response, dtype=complex), size)
    return Lines(HZ, values, np.full(size, noise), np.ones(size), 1.0, 8)


@pytest.fixture
def study(tmp_path):
    return CouplingStudy(STAGE, [], tmp_path)


def measured(monkeypatch, study, seen):
    """Return the coupling of runs in which sensor x sees y with a response, and y sees no other."""
    found = iter([lines(1.0), lines(0.0), lines(seen), lines(1.0)])
    monkeypatch.setattr("hilctl.lab.studies.couple.crossed", lambda *_: None)
    monkeypatch.setattr("hilctl.lab.studies.couple.excited_lines", lambda *_: next(found))
    steps = study.study()
    step = next(steps)
    settings = [step.settings]
    for _ in range(2):
        step = steps.send(_run(step))
        settings.append(step.settings)
    return settings


def _run(step):
    run = StudyRun(step, ())
    run.__dict__["recordings"] = (None, None)
    return run


def test_each_axis_moves_while_the_others_hold(study, monkeypatch):
    first, second, verified = measured(monkeypatch, study, 0.04)
    kinds = []
    for settings in (first, second):
        axes = load_axes(STAGE, settings)
        kinds.append([each.config.waveform.parts[0].kind for each in axes])
        offsets = [each.config.waveform.parts[0].offset for each in axes]
        assert offsets == pytest.approx([-6.9, -6.9])
        assert not {"amplitude", "frequency_hz"} & axes[0].document.data["waveform"].keys()
        assert all(each.coupling is None for each in axes)
    assert kinds == [["multisine", "hold"], ["hold", "multisine"]]
    seeds = [[each.config.device["seed"] for each in load_axes(STAGE, s)] for s in (first, second)]
    assert seeds == [[2, 3], [3, 4]]
    axes = load_axes(STAGE, verified)
    (found,) = axes[0].coupling.into["x"].values()
    assert found.taps == pytest.approx([0.04])
    assert (found.grade, axes[0].coupling.into["y"]) == ("good", {})


def test_what_is_no_linear_response_is_refused(study, monkeypatch):
    rng = np.random.default_rng(1)
    scattered = 0.04 * np.exp(2j * np.pi * rng.random(HZ.size))
    with pytest.raises(RunError, match="of y into x"):
        measured(monkeypatch, study, scattered)


@pytest.mark.parametrize("own", [
    ["axes.x.feedback={kind: integral, bandwidth_hz: 1.0, limit_um: 1.0}"],
    ["compensator.correction=missing.yaml"],
    ["coupling=missing.yaml"],
    ["waveform.frequency_hz=10", "axes.y.waveform.amplitude=20.0"],
])  # fmt: skip
def test_keys_that_would_change_the_response_are_left_out(tmp_path, own):
    study = CouplingStudy(STAGE, own, tmp_path)
    step = next(study.study())
    for axis in load_axes(STAGE, step.settings):
        assert (axis.config.feedback, axis.correction, axis.coupling) == (None, None, None)


@pytest.mark.parametrize("settings", [
    ["axis=x"],
    ["axes.y.compensator=none", "axes.y.waveform.unit=A", "axes.y.waveform.amplitude=1"],
    ["waveform={kind: hold, unit: um, level: 0.0, duration_s: 1.0}",
     "axes.x.waveform={kind: hold}"],
])  # fmt: skip
def test_unfit_experiments_are_refused(tmp_path, settings):
    with pytest.raises(ConfigError):
        CouplingStudy(STAGE, settings, tmp_path)


@pytest.mark.parametrize("highest_hz", [-1.0, 25e3])
def test_highest_frequency_is_within_half_the_rate(tmp_path, highest_hz):
    with pytest.raises(InputError, match="highest-hz"):
        CouplingStudy(STAGE, [], tmp_path, highest_hz)
