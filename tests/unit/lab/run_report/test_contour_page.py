"""Page of a run of several axes, and the magnification of its error."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.analysis.contour import ContourTrace, contour
from hilctl.base.segments import Segment
from hilctl.lab.pages.figure_layout import drawn
from hilctl.lab.run_report.contour_page import contour_page, contour_sheets, magnification
from tests.unit.lab.run_report.test_run_page import NASTY, Page


def trace(error_um, size=200):
    phase = 2.0 * np.pi * np.arange(size) / size
    circle = np.column_stack([np.cos(phase), np.sin(phase)])
    along = np.zeros(size)
    return ContourTrace(
        np.arange(size), 30.0 * circle, (30.0 + error_um) * circle, 30.0 * circle,
        along + error_um, along, along, along,
    )  # fmt: skip


@pytest.mark.parametrize(("error_um", "times"), [
    (0.0, 1.0), (40.0, 1.0), (5.0, 1.0), (0.59, 10.0), (0.25, 20.0), (0.1, 50.0), (5.9e-4, 1e4),
])  # fmt: skip
def test_magnification_is_1_2_or_5_times_a_power_of_ten(error_um, times):
    assert magnification(trace(error_um)) == pytest.approx(times)


def test_path_shows_the_magnified_distance_to_scale():
    paths, errors = contour_sheets(trace(0.1), ["x", "y"], "circle", 1000.0)
    (axes,) = drawn(paths).axes
    assert axes.get_aspect() == 1.0
    reference, measured, _ = (np.hypot(*line.get_data()) for line in axes.get_lines())
    np.testing.assert_allclose(reference, 30.0)
    np.testing.assert_allclose(measured, 30.0 + 50.0 * 0.1)
    across, along = drawn(errors).axes
    np.testing.assert_allclose(across.get_lines()[0].get_ydata(), 0.1)
    np.testing.assert_array_equal(along.get_lines()[0].get_ydata(), 0.0)


@pytest.mark.parametrize("parts", [1, 2])
def test_page_has_the_contour_and_each_axis(make_recording, parts):
    phase = 2.0 * np.pi * np.arange(4000) / 1000
    half = 4000 // parts
    segments = [Segment(f"{NASTY} {k}", k * half, (k + 1) * half, k * half, (k + 1) * half, 1000.0)
                for k in range(parts)]  # fmt: skip
    runs = {
        name: make_recording(
            30.1 * wave(phase), reference_um=30.0 * wave(phase), segments=segments,
            run={"name": NASTY},
        )
        for name, wave in {"x": np.cos, NASTY: np.sin}.items()
    }  # fmt: skip
    report, traces = contour({name: [each] for name, each in runs.items()})
    page = Page(contour_page(report, traces, runs))
    assert not page.open
    assert "script" not in page.tags
    assert "img" not in page.tags
    assert all(each.startswith("#") for each in page.references)
    assert page.text.count("Axis ") == 2
    assert "100 nm peak" in page.text
    assert ("lag ms" in page.text) == (parts > 1)


def test_page_without_evaluated_samples(make_recording):
    runs = {name: make_recording(np.zeros(50), run={"name": "none"}) for name in "xy"}
    report, traces = contour({name: [replace(each)] for name, each in runs.items()})
    page = Page(contour_page(report, traces, runs))
    assert "Axis y" in page.text
    assert "contour error" not in page.text
