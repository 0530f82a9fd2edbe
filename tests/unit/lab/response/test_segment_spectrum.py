"""Harmonics of sines, and noise at rest, of known recordings."""

import json

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.lab.response.segment_spectrum import (
    spectra,
    spectrum_rows,
    spectrum_sheets,
    write_spectra,
)

RATE_HZ = 10_000.0
N = 20_000
T = np.arange(N) / RATE_HZ
NOISE_UM = 0.05 * np.random.default_rng(2).standard_normal(N)
REST = Segment("hold 0 A", 0, N, 0, N)
SINE = Segment("sine 1 A 50 Hz", 0, N, 0, N, 200.0)
TURNS = 2.0 * np.pi * 50.0 * T
MOVED_UM = 8.0 * np.sin(TURNS) + 0.3 * np.sin(2.0 * TURNS + 1.0) + 0.4 * np.cos(3.0 * TURNS)


@pytest.fixture
def recorded(make_recording):
    def make(displacement_um, segment, **more):
        return make_recording(displacement_um, segments=[segment], sample_rate_hz=RATE_HZ, **more)

    return make


@pytest.mark.parametrize("label", ["hold 0 A", "step 0 A"])
def test_noise_drift_and_hum_at_rest(recorded, label):
    """50 Hz of 0.2 um, 0.05 um of noise, 0.3 um/s of drift."""
    values_um = 7.0 + 0.3 * T + 0.2 * np.sin(TURNS) + NOISE_UM
    (found,) = spectra(recorded(values_um, Segment(label, 0, N, 0, N)))
    rest = found.rest
    assert found.sine is None
    assert rest.mean_um == pytest.approx(7.3, abs=0.01)
    assert rest.drift_um_per_s == pytest.approx(0.3, abs=0.01)
    assert rest.noise_um == pytest.approx(np.hypot(0.05, 0.2 / np.sqrt(2.0)), rel=0.01)
    assert 0.3 < rest.peak_um < 0.2 + 6.0 * 0.05
    assert rest.span_um > 0.6
    assert (rest.line_hz, rest.line_um) == (50.0, pytest.approx(0.2, rel=0.02))
    assert found.median_density_um == pytest.approx(0.05 * np.sqrt(2.0 / RATE_HZ), rel=0.02)
    lowest = rest.allan_um.min()
    assert rest.bias_instability_um == pytest.approx(lowest / 0.664, rel=1e-3)
    assert rest.allan_um[rest.averaging_s == rest.bias_time_s] == [lowest]


@pytest.mark.parametrize("period", [200.0, 400.0 / 3.0])
def test_harmonics_and_distortion_of_a_sine(recorded, period):
    turns = 2.0 * np.pi * np.arange(N) / period
    moved_um = 8.0 * np.sin(turns) + 0.3 * np.sin(2.0 * turns + 1.0) + 0.4 * np.cos(3.0 * turns)
    segment = Segment("sine 1 A", 0, N, 0, N, period)
    (found,) = spectra(recorded(moved_um + NOISE_UM + T, segment, command=np.sin(turns)))
    sine = found.sine
    assert found.rest is None
    assert sine.frequency_hz == pytest.approx(RATE_HZ / period)
    np.testing.assert_allclose(sine.harmonics_um[:4], [8.0, 0.3, 0.4, 0.0], atol=0.01)
    assert sine.thd_percent == pytest.approx(100.0 * 0.5 / 8.0, rel=0.01)
    expected_um = 0.05 * np.sqrt(2.0 / N)  # of the real and the imaginary part together, doubled
    assert np.sqrt(np.mean(sine.noise_um**2)) == pytest.approx(np.sqrt(2.0) * expected_um, rel=0.1)
    assert sine.thd_noise_percent < 0.1
    assert found.median_density_um == pytest.approx(0.05 * np.sqrt(2.0 / RATE_HZ), rel=0.05)


def test_other_motions_and_missing_readings_are_refused(recorded):
    moving = Segment("random 1 A", 0, N, 0, N)
    with pytest.raises(DataError, match=r"random.*--from"):
        spectra(recorded(MOVED_UM, moving, command=MOVED_UM))
    with pytest.raises(DataError, match="20000 of 20000 samples"):
        spectra(recorded(np.full(N, np.nan), REST))


def test_a_silent_sensor_has_no_noise(recorded):
    (found,) = spectra(recorded(np.zeros(N), REST))
    assert (found.rest.noise_um, found.median_density_um) == (0.0, 0.0)
    assert dict(spectrum_rows(found))["noise"] == "0 µm rms"


def test_the_page_has_one_column_per_segment(recorded, tmp_path):
    rest, sine = (
        spectra(recorded(NOISE_UM, REST))[0],
        spectra(recorded(MOVED_UM + NOISE_UM, SINE, command=np.sin(TURNS)))[0],
    )
    names = {sheet.name for sheet in spectrum_sheets([rest])}
    assert names == {"density", "allan"}
    assert {sheet.name for sheet in spectrum_sheets([rest, sine])} == {*names, "harmonics"}
    for found in ([rest], [rest, sine]):
        write_spectra(found, tmp_path / "spectrum.html")
        page = (tmp_path / "spectrum.html").read_text(encoding="utf-8")
        assert page.count("<svg ") == len(spectrum_sheets(found))
        assert all(f">{key}<" in page for each in found for key, _ in spectrum_rows(each))
    plain = json.loads(json.dumps(rest.to_mapping()))
    assert len(plain["rest"]["allan_um"]) == rest.rest.allan_um.size
    assert plain["sine"] is None
