"""Published compensation of chapters 3, 5 and 6, in complete runs without real time.

The rig is fitted to the figures of the dissertation, not to its data: where the published
parameters do not give the published figure on it, the test says which they do give.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.models.model_file import dump_model
from hilctl.models.plays import SpiModel
from hilctl.recording.reader import read
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced
from tests.published import piezo_ppi, terfenol_rdpi

CONFIGS = Path(__file__).parents[2] / "configs"
SINE = CONFIGS / "terfenol_sine_6a.yaml"
PEAK_UM = 13.0
CENTRE_UM = -1.08
"""What 2.3 A moves, and the middle of that."""

pytestmark = pytest.mark.long


@pytest.fixture
def run(tmp_path):
    """Return a function that runs an experiment with settings, and gives its recording."""

    def run_with(path, *settings):
        output = tmp_path / "run.mcap"
        result = run_unpaced(checked_run(path, settings), output, overwrite=True)
        assert result.code == "completed"
        return read(output)

    return run_with


@pytest.fixture
def model_setting(tmp_path):
    """Return a function that writes a model file, and gives the setting that names it."""

    def of(model):
        file = tmp_path / "model.yaml"
        file.write_text(dump_model(model))
        return f"compensator.model={file}"

    return of


def small(frequency_hz):
    """Settings for what 2.3 A moves, three steady cycles and more."""
    return (
        f"waveform.amplitude={PEAK_UM}",
        f"waveform.offset={CENTRE_UM}",
        f"waveform.frequency_hz={frequency_hz}",
        f"waveform.duration_s={0.4 + max(0.1, 3.02 / frequency_hz):.5f}",
    )


@pytest.mark.parametrize("name", ["piezo_sine", "piezo_complex"])
def test_stop_operators_compensate_the_piezo_stage(run, model_setting, name):
    """Chapter 3's SPI, by the published numbers, under a sine and the complex harmonic."""
    spi = SpiModel(**piezo_ppi().model_dump(exclude={"kind"}))
    recording = run(CONFIGS / f"{name}.yaml", model_setting(spi))
    report = summarize(recording)
    assert report.peak_error_percent is not None
    assert report.peak_error_percent <= 1.0
    assert replay(recording).identical


@pytest.mark.parametrize("frequency_hz", [1.0, 25.0, 50.0, 100.0, 150.0, 200.0])
def test_four_plays_straighten_small_strokes(run, frequency_hz):
    """Chapter 5: n = 4 at 2.3 A, 1 to 200 Hz, leaves at most 4.96 % of 18 and more.

    The model is the shipped one, identified on this rig as published. The published 4.96 % are
    0.645 um of the peak displacement, 13 um; these are of the peak-to-peak, as all figures here.
    """
    (segment,) = summarize(
        run(SINE, "compensator.model=models/terfenol_rdpi.yaml", *small(frequency_hz))
    ).segments
    assert segment.peak_to_peak_um > 25.5
    assert segment.peak_hysteresis_percent <= 4.96


@pytest.mark.parametrize(
    ("frequency_hz", "percent"), [(1.0, 3.2), (100.0, 2.7), (175.0, 5.0), (200.0, 5.4)]
)
def test_published_parameters_on_this_rig(run, model_setting, frequency_hz, percent):
    """Chapter 5's own parameters, found on another specimen, miss 4.96 % at 200 Hz by 0.4."""
    (segment,) = summarize(run(SINE, model_setting(terfenol_rdpi()), *small(frequency_hz))).segments
    assert segment.peak_hysteresis_percent == pytest.approx(percent, abs=0.3)


def test_four_plays_straighten_minor_loops(run):
    """Chapter 5's complex harmonic, sin(100 pi t) + 1.3 sin(90 pi t): no figure is published."""
    parts = [
        {"amplitude": round(PEAK_UM / 2.3 * share, 4), "frequency_hz": frequency_hz}
        for share, frequency_hz in ((1.0, 50.0), (1.3, 45.0))
    ]
    recording = run(
        CONFIGS / "terfenol_complex_50_100.yaml",
        "compensator.model=models/terfenol_rdpi.yaml",
        f"waveform.components={json.dumps(parts)}",
        f"waveform.offset={CENTRE_UM}",
    )
    (segment,) = summarize(recording).segments
    samples = recording.samples.part(
        recording.segments[0].steady_start, recording.segments[0].steady_stop
    )
    error_um = samples.displacement_um - samples.reference_um
    assert segment.peak_to_peak_um > 24.0
    assert np.max(np.abs(error_um - error_um.mean())) <= 1.3


@pytest.mark.parametrize("frequency_hz", [1.0, 50.0, 100.0, 150.0, 200.0])
def test_half_the_current_is_compensated_too(run, frequency_hz):
    """Chapter 6 at 3 A: the shipped Omega leaves at most 3.7 % up to 200 Hz."""
    settings = ["waveform.amplitude=18.4", "waveform.offset=-1.9", *small(frequency_hz)[2:]]
    (segment,) = summarize(run(SINE, *settings)).segments
    assert segment.peak_to_peak_um > 36.0
    assert segment.peak_hysteresis_percent <= 3.7


def test_published_figure_at_250_hz_takes_the_stages(run):
    """Omega alone leaves 5 to 6 % at 6 A and 250 Hz on this rig, with its stages below 1 %."""
    settings = ("waveform.frequency_hz=250.0", "waveform.duration_s=0.6")
    (alone,) = summarize(run(SINE, *settings)).segments
    staged = "compensator.model=models/terfenol_staged.yaml"
    (whole,) = summarize(run(SINE, *settings, staged)).segments
    assert 3.7 < alone.peak_hysteresis_percent < 6.0
    assert whole.peak_hysteresis_percent <= 1.0
