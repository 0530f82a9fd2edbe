"""Refining on the simulated rig: from recordings of compensated runs to a smaller error."""

from pathlib import Path

from hilctl import api
from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.recording.reader import read
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced

CONFIGS = Path(__file__).parents[2] / "configs"
SINE = CONFIGS / "terfenol_sine_6a.yaml"
STAGED = CONFIGS / "models" / "terfenol_staged.yaml"
OMEGA = CONFIGS / "models" / "terfenol_omega.yaml"  # identified on full strokes


def run(path, model, frequency_hz, amplitude_um, seed, strain=1.05):
    """Run a rig that moves 5 % further than the one of the model; return its recording."""
    settings = [
        f"compensator.model={model}", f"waveform.frequency_hz={frequency_hz}",
        f"waveform.amplitude={amplitude_um}", f"device.seed={seed}", f"device.vary.strain={strain}",
        f"waveform.duration_s={0.5 + 3.0 / frequency_hz:.4f}",
    ]  # fmt: skip
    run_unpaced(checked_run(SINE, settings), path)
    return path


def test_compensated_runs_make_a_model_better_on_another_reference(tmp_path):
    given = ((20.0, 34.0), (60.0, 30.0), (120.0, 34.0), (150.0, 20.0))
    runs = [
        run(tmp_path / f"{i}.mcap", STAGED, frequency_hz, size, seed=i + 2)
        for i, (frequency_hz, size) in enumerate(given)
    ]
    better = tmp_path / "better.yaml"
    assert api.refine(STAGED, runs, better).better
    was, now = (
        summarize(read(run(tmp_path / f"{name}.mcap", model, 90.0, 28.0, seed=40)))
        for name, model in (("was", STAGED), ("now", better))
    )
    assert now.peak_error_percent < 0.3 * was.peak_error_percent
    assert replay(read(tmp_path / "now.mcap")).identical


def test_model_of_full_strokes_improves_on_small_references(tmp_path):
    given = ((60.0, 38.0), (150.0, 34.0), (100.0, 18.0), (40.0, 10.0), (120.0, 4.0))
    runs = [
        run(tmp_path / f"{i}.mcap", OMEGA, *reference, seed=10 + i, strain=1.0)
        for i, reference in enumerate(given)
    ]
    better = tmp_path / "better.yaml"
    assert api.refine(OMEGA, runs, better).better

    unseen = ((110.0, 36.0), (15.0, 19.0), (90.0, 9.0), (50.0, 4.0))
    was, now = (
        [
            summarize(
                read(run(tmp_path / f"{model.stem}_{i}.mcap", model, *reference, 40 + i, 1.0))
            ).rms_error_percent
            for i, reference in enumerate(unseen)
        ]
        for model in (OMEGA, better)
    )
    assert all(after < 0.5 * before for before, after in zip(was, now, strict=True))
