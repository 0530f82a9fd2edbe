"""A reference held against the motions that the model was identified on."""

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.experiment.model_validity import range_findings, spectrum
from hilctl.models.base import IdentifiedRange, Provenance
from hilctl.waveforms.build import Reference
from tests.published import terfenol_rdpi

RATE_HZ = 10_000.0
KNOWN = IdentifiedRange(
    peak_to_peak_um=(20.0, 80.0), frequency_hz=(10.0, 100.0), speed_um_per_s=25_000.0
)


def findings(values_um, frequency_hz=0.0, **more):
    period = RATE_HZ / frequency_hz if frequency_hz else 0.0
    segment = Segment("s", 0, values_um.size, 0, values_um.size, period)
    span = float(values_um.min()), float(values_um.max())
    provenance = Provenance(identified_range=KNOWN, errors_by_stroke={"half stroke": 1.5}, **more)
    model = terfenol_rdpi().model_copy(update={"provenance": provenance})
    return range_findings(model, Reference(values_um, "um", RATE_HZ, (segment,), span))


def sine(frequency_hz, amplitude=40.0, seconds=1.0):
    return amplitude * np.sin(2.0 * np.pi * frequency_hz * np.arange(seconds * RATE_HZ) / RATE_HZ)


@pytest.mark.parametrize("frequency_hz", [10.0, 37.0, 100.0])
def test_within_the_range_there_is_nothing_to_say(frequency_hz):
    found = findings(sine(frequency_hz), frequency_hz)
    assert (found.refused, found.warnings) == ((), ())


@pytest.mark.parametrize(
    ("amplitude", "frequency_hz", "percent"),
    [
        (20.0, 50.0, 1.5),
        (40.0, 50.0, None),
        (20.0, 150.0, None),
        (10.0, 50.0, None),
    ],
)
def test_expected_error_is_that_of_the_stroke_within_the_range(amplitude, frequency_hz, percent):
    found = findings(sine(frequency_hz, amplitude), frequency_hz).expected
    assert (found and found.percent) == percent


def test_expected_error_has_the_median_and_the_worst_motion_of_the_model_file():
    more = {"median_by_stroke": {"half stroke": 0.7}, "worst_by_stroke": {"half stroke": "4 %"}}
    found = findings(sine(50.0, 20.0), 50.0, **more).expected
    assert (found.percent, found.median_percent, found.worst) == (1.5, 0.7, "4 %")
    older = findings(sine(50.0, 20.0), 50.0).expected
    assert (older.percent, older.median_percent, older.worst) == (1.5, None, "")


def test_somewhat_faster_is_warned_and_much_faster_refused():
    assert "up to about 15" in findings(sine(150.0, 20.0)).warnings[0]
    assert "at about 250 Hz" in findings(sine(250.0)).refused[0].rule


def test_a_corner_is_warned_not_refused():
    triangle = 40.0 * (2.0 / np.pi) * np.arcsin(sine(80.0, 1.0))
    found = findings(triangle, 80.0)
    assert not found.refused
    assert "frequencies up to" in found.warnings[0]


@pytest.mark.parametrize(("values", "frequency_hz", "text"), [
    (sine(50.0, 4.0), 50.0, "moves by 8 µm peak-to-peak"),
    (sine(2.0, 40.0), 2.0, "repeats at 2 Hz"),
    (sine(50.0, 40.0) + np.where(np.arange(10_000) > 5003, 8.0, 0.0), 0.0, "µm/s"),
])  # fmt: skip
def test_smaller_slower_and_faster_motions_are_warned(values, frequency_hz, text):
    found = findings(values, frequency_hz)
    assert any(text in each for each in found.warnings)
    assert not found.refused


def test_what_hardly_moves_has_no_frequency():
    rest = np.concatenate((sine(20.0), sine(900.0, 0.5), np.zeros(5000)))
    assert not findings(rest).refused
    assert findings(rest).warnings == ()
    assert spectrum(np.zeros(1000), RATE_HZ, 10.0).highest_hz == 0.0


@pytest.mark.parametrize("frequency_hz", [0.3, 1.0, 7.77, 37.0, 800.0])
def test_the_highest_frequency_of_a_sine_is_its_own(frequency_hz):
    found = spectrum(sine(frequency_hz, seconds=30.0), RATE_HZ, frequency_hz)
    assert found.highest_hz == pytest.approx(frequency_hz, abs=0.6 * found.resolution_hz)
    assert found.resolution_hz <= max(frequency_hz / 8.0, 5.0) * 1.01


def test_a_slow_model_bounds_the_reference_as_well():
    slow = KNOWN.model_copy(update={"frequency_hz": (1.0, 1.0)})
    segment = Segment("s", 0, 100_000, 0, 100_000, 0.0)
    for frequency_hz, warned, refused in ((1.0, 0, 0), (1.6, 1, 0), (2.5, 0, 1)):
        values_um = sine(frequency_hz, seconds=10.0)
        reference = Reference(values_um, "um", RATE_HZ, (segment,), (-40.0, 40.0))
        known = {"provenance": Provenance(identified_range=slow)}
        found = range_findings(terfenol_rdpi().model_copy(update=known), reference)
        assert (len(found.warnings), len(found.refused)) == (warned, refused)


@pytest.mark.parametrize("frequency_hz", [1.0, 5.0, 10.0, 20.0])
@pytest.mark.parametrize("share", [0.05, 0.5, 1.0])
def test_triangles_are_not_as_quick_as_their_corners(frequency_hz, share):
    """Between the corners nothing but rounding errors is beside a straight line."""
    time_s = np.arange(8000) / 1000.0
    sine_of = np.sin(2.0 * np.pi * frequency_hz * time_s)
    triangle_um = share * 100.0 / np.pi * np.arcsin(sine_of)
    assert spectrum(triangle_um, 1000.0, 100.0, 2.0).main_hz <= 1.2 * frequency_hz + 5.0
