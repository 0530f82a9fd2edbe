"""A base experiment, and campaigns over it."""

from pathlib import Path

import pytest

from hilctl.lab.studies.campaign.steps import load_campaign

EXPERIMENT = """\
name: rig
device: {kind: simulated_terfenol, seed: 3}
sample_rate_hz: 2000
block: 20
waveform: {kind: sine, unit: A, amplitude: 2.0, frequency_hz: 20.0, duration_s: 0.4}
compensator: none
limits: {peak_current_a: 4.0, slew_a_per_s: 5000.0, stroke_um: [-50.0, 50.0]}
"""
CAMPAIGN = """\
name: few
experiment: rig.yaml
vary:
  waveform.amplitude: [1.0, 2.0]
  waveform.frequency_hz: [10.0, 20.0]
"""


@pytest.fixture(autouse=True)
def drawn_pages(monkeypatch) -> list[tuple[str, int]]:
    """Replace the page, which takes seconds; return its name and number of completed runs."""
    pages: list[tuple[str, int]] = []

    def write(series, path):
        path.write_text("page", encoding="utf-8")
        pages.append((path.name, len(series.done)))

    monkeypatch.setattr("hilctl.lab.studies.campaign.campaign_runner.write_series", write)
    return pages


@pytest.fixture
def experiment(tmp_path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(EXPERIMENT, encoding="utf-8")
    return path


@pytest.fixture
def campaign(experiment):
    """Return a factory of campaigns from YAML text and settings."""

    def make(text=CAMPAIGN, *settings):
        path = experiment.with_name("few.yaml")
        path.write_text(text, encoding="utf-8")
        return load_campaign(path, settings)

    return make
