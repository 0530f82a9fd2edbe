"""The comparison that the dissertation makes (section 4.5), on the simulated rig."""

import json
from pathlib import Path

import pytest

from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.experiment.load import load_experiment
from hilctl.lab.comparison.simulated_trials import TrialDevice
from hilctl.recording.reader import read
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced
from tests.commands import hilctl

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("compare")


@pytest.fixture(scope="module")
def models(folder):
    """Every model of the catalogue on the loops of chapter 4, by name, as the command prints it."""
    loops, page = folder / "loops.mcap", folder / "models.html"
    run = run_unpaced(checked_run(CONFIGS / "identify_omega_chapter4.yaml", []), loops)
    assert run.code == "completed"
    ended = hilctl("compare", loops, "--html", page, "--save", folder, "--json")
    return {model["name"]: model for model in json.loads(ended.stdout)["models"]}


def at(model, part, frequency_hz):
    """The largest peak error at a frequency, of the loops or of the trials."""
    key = "peak_percent" if part == "loops" else "peak_error_percent"
    return max(
        entry[key] for entry in model[part] if abs(entry["frequency_hz"] - frequency_hz) < 0.5
    )


def test_omega_meets_the_published_model_error(models):
    """3.72 % on loops of 3 and 7 A."""
    assert models["integrated"]["peak_percent"] <= 3.72


@pytest.mark.parametrize("name", ["asymmetric", "rdpi"])
def test_without_rate_or_deadbands_the_model_error_is_several_times_larger(models, name):
    """Published at 200 Hz: 13.5 and 9.6 %, 3.6 and 2.6 times that of Omega."""
    assert at(models[name], "loops", 200.0) >= 2.5 * at(models["integrated"], "loops", 200.0)


def test_every_other_model_is_worse_over_the_band(models):
    others = set(models) - {"integrated", "staged"}
    assert len(others) == 9
    for name in others:
        assert models[name]["peak_percent"] >= 2.5 * models["integrated"]["peak_percent"], name


def test_compensated_the_order_is_the_same(models):
    """The largest error from 10 to 200 Hz is Omega's, and at 10 Hz others have 2.5 times as much.

    At 200 Hz Omega's is mostly its own inverse's, whose thresholds follow the reference's rate and
    not the command's (before Omega itself it leaves 10 %); stages around it take that away.
    """
    omega = models["integrated"]
    for name in set(models) - {"integrated", "staged"}:
        other = models[name]
        assert other["compensated_peak_percent"] > omega["compensated_peak_percent"], name
        assert at(other, "compensated", 10.0) >= 2.5 * at(omega, "compensated", 10.0), name
    staged = at(models["staged"], "compensated", 200.0)
    for name in ("asymmetric", "rdpi"):
        assert at(models[name], "compensated", 200.0) >= 2.5 * staged, name


@pytest.mark.parametrize("name", ["preisach", "kp"])
def test_a_saved_model_runs_like_any_other(models, folder, name):
    path = folder / f"{name}.mcap"
    settings = [f"compensator.model={folder / name}.yaml", "waveform.frequency_hz=100",
                "waveform.duration_s=0.5"]  # fmt: skip
    run = run_unpaced(checked_run(CONFIGS / "terfenol_sine_6a.yaml", settings), path)
    assert run.code == "completed"
    recording = read(path)
    assert replay(recording).identical
    loaded = load_experiment(CONFIGS / "terfenol_sine_6a.yaml", settings)
    device = TrialDevice(loaded, [loaded.config.waveform])
    (trial,) = device.run(loaded.model, device.references[0])
    report = summarize(recording)
    for figure in ("peak_hysteresis_percent", "peak_error_percent", "rms_error_percent"):
        assert getattr(report, figure) == pytest.approx(getattr(trial, figure), rel=1e-9), figure


def test_the_page_is_written(models, folder):
    text = (folder / "models.html").read_text()
    assert all(name in text for name in models)
    assert "<svg" in text
