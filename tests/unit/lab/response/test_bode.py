"""Bode plot, table and page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.lab.pages.figure_layout import drawn
from hilctl.lab.response import bode
from hilctl.lab.response.frequency_response import FreeLines, FrequencyResponse

HZ = np.geomspace(10.0, 1000.0, 30)
ANSWER = 4.0 / (1.0 + 1j * HZ / 300.0)
SMALL = FrequencyResponse(
    path=Path("run.mcap"),
    signals="command-displacement",
    unit="um/A",
    excitation="multisine 0.2 A 10-1000 Hz",
    method="periods",
    averages=9,
    amplitude=0.2,
    excited_lines=30,
    frequency_hz=HZ,
    response=ANSWER,
    noise=np.full(30, 0.1),
    coherence=np.full(30, 0.999),
    free=None,
    gain_um=4.0,
    delay_s=1e-4,
    lag_s=5e-4,
    natural_hz=700.0,
    damping_ratio=0.1,
    further=(),
    bandwidth_hz=None,
    errors={"gain_um": 0.01, "delay_s": 1e-6, "lag_s": 1e-6, "natural_hz": 1.0},
    misfit_percent=1.0,
    fitted=ANSWER,
)


def test_one_response_shows_band_and_resonance():
    sheet = bode.response_sheet([SMALL], band_hz=(1.0, 50.0))
    upper, middle, lower = drawn(sheet).axes
    assert upper.get_ylabel() == "magnitude, µm/A"
    assert any(np.allclose(line.get_xdata(), 700.0) for line in upper.lines)
    np.testing.assert_allclose(middle.lines[-1].get_ydata()[-1], -np.degrees(np.arctan(10.0 / 3.0)))
    np.testing.assert_allclose(lower.lines[-1].get_ydata(), 0.999)


def test_the_fitted_phase_is_not_a_turn_away():
    falling = replace(SMALL, response=-ANSWER, fitted=-ANSWER * np.exp(-1e-9j), natural_hz=None)
    middle = drawn(bode.response_sheet([falling])).axes[1]
    measured, fitted = (line.get_ydata() for line in middle.lines)
    np.testing.assert_allclose(measured, fitted, atol=1e-3)


@pytest.mark.parametrize("free", [None, FreeLines(0.5, float("nan"), 0.1)])
def test_rows_of_a_response(free):
    rows = dict(bode.fit_rows(replace(SMALL, free=free, lag_s=0.0)))
    assert rows["gain"] == "4.000 µm/A ± 0.010 µm/A"
    assert rows["quality factor"] == "5.00"
    assert rows["lag"] == "-"
    assert ("lines not excited" in rows) == (free is not None)
    headings, lines = bode.line_table(SMALL)
    assert len(lines) <= 24
    assert {len(line) for line in lines} == {len(headings)}


def test_a_page_of_several_responses(tmp_path):
    other = replace(SMALL, path=Path("other.mcap"), natural_hz=None, damping_ratio=None)
    bode.write_responses([SMALL, other], tmp_path / "frf.html")
    page = (tmp_path / "frf.html").read_text(encoding="utf-8")
    assert page.count("<th class") >= 3
    assert ">other<" in page
