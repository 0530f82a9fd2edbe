"""Lines of the error."""

import numpy as np
import pytest

from hilctl.desk.signals import ROW, SIGNALS, Traces
from hilctl.desk.spectrum import ErrorSpectrum


def error(error_um, start=0):
    values = np.zeros((len(SIGNALS), error_um.size))
    values[ROW["error"]] = error_um
    index = np.arange(start, start + error_um.size)
    return Traces(index, values, np.zeros(error_um.size, dtype=np.uint32))


def test_a_line_is_as_high_as_its_sine_and_stands_at_its_frequency():
    spectrum = ErrorSpectrum(50000.0)
    t_s = np.arange(16384) / 50000.0
    spectrum.add(error(5.0 + 0.3 * np.sin(2 * np.pi * 1000.0 * t_s)))
    hz, um = spectrum.points()
    assert um.max() == pytest.approx(0.3, rel=0.1)
    assert hz[um.argmax()] == pytest.approx(1000.0, rel=0.05)


def test_no_points_before_there_are_samples_and_a_gap_begins_anew():
    spectrum = ErrorSpectrum(1000.0)
    assert spectrum.points()[0].size == 0
    spectrum.add(error(np.zeros(300)))
    assert spectrum.points()[0].size > 0
    spectrum.add(error(np.array([np.nan, 1.0])))
    assert spectrum.points()[0].size == 0
