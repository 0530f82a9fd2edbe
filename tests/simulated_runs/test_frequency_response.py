"""The shipped experiment finds the simulated rig's resonance, whatever its load."""

import math
from pathlib import Path

import pytest

from hilctl import api

EXPERIMENT = Path(__file__).parents[2] / "configs" / "frequency_response.yaml"
STIFFNESS_N_PER_M, MOVING_KG, DAMPING = 33.597e6, 0.162, 0.12
LAGS_S = 1.0 / (2.0 * math.pi * 10e3) + 1.0 / (2.0 * math.pi * 15e3)
"""Time constants of amplifier and sensor, which delay all lower frequencies."""


@pytest.mark.parametrize(("load_kg", "last_hz"), [(0.0, 4010.0), (3.7, 1410.0), (9.2, 1010.0)])
def test_resonance_and_delay_of_a_load(tmp_path, load_kg, last_hz):
    settings = {"device.load_kg": load_kg, "waveform.last_hz": last_hz}
    settings |= {"recording.folder": str(tmp_path)}
    page = tmp_path / "frf.html"
    (found,) = api.frf(api.run(EXPERIMENT, settings=settings, fast=True).path, page)
    true_hz = math.sqrt(STIFFNESS_N_PER_M / (MOVING_KG + load_kg)) / (2.0 * math.pi)
    assert found.natural_hz == pytest.approx(true_hz, rel=0.01)
    assert found.damping_ratio == pytest.approx(DAMPING, rel=0.05)
    assert found.delay_s == pytest.approx(LAGS_S, abs=0.5 / 50_000.0)
    assert found.coherence[found.frequency_hz < found.bandwidth_hz].min() > 0.99
    assert found.free.even_percent > 2.0 * found.free.noise_percent  # hysteresis
    assert page.is_file()
