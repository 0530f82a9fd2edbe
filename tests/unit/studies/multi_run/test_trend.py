"""A figure against what varied."""

from dataclasses import replace

import pytest

from hilctl.studies.multi_run.trend import AREA, ASYMMETRY, HYSTERESIS, STROKE, extremes, trends


def by_name(series):
    return {each.name: each for each in series.dimensions}


def test_a_line_is_fitted_for_all_values_of_the_others(crossed):
    found = trends(crossed, AREA, by_name(crossed)["frequency"])
    assert [trend.held for trend in found] == [
        {"waveform.amplitude": 3.0},
        {"waveform.amplitude": 6.0},
    ]
    assert [(t.slope, t.offset, t.r2) for t in found] == [
        (pytest.approx(1.5), pytest.approx(60.0), pytest.approx(1.0)),
        (pytest.approx(3.0), pytest.approx(120.0), pytest.approx(1.0)),
    ]
    assert {trend.direction for trend in found} == {"rises"}


def test_directions(crossed):
    dims = by_name(crossed)
    assert {t.direction for t in trends(crossed, STROKE, dims["frequency"])} == {"does not change"}
    assert {t.direction for t in trends(crossed, STROKE, dims["amplitude"])} == {"rises"}
    mixed = [
        replace(run, figures=replace(run.figures, loop_area=area))
        for run, area in zip(crossed.runs[:3], (3.0, 1.0, 2.0), strict=True)
    ]
    assert trends(crossed, AREA, dims["frequency"], mixed)[0].direction == ""


def test_two_points_have_no_fit_and_repeats_count_once(crossed):
    """A line through two points says nothing about being one."""
    along = by_name(crossed)["amplitude"]
    found = trends(crossed, AREA, along, [*crossed.runs, *crossed.runs])
    assert len(found) == 3
    assert all(trend.r2 is None and trend.x.size == 2 for trend in found)


def test_what_a_run_has_not_is_left_out(crossed):
    few = [replace(run, figures=replace(run.figures, loop_area=None)) for run in crossed.runs]
    assert trends(crossed, AREA, by_name(crossed)["frequency"], few) == []
    assert extremes(AREA, few) is None


def test_extremes_and_asymmetry(crossed):
    (best, low), (worst, high) = extremes(HYSTERESIS, crossed.runs)
    assert (low, high) == (11.0, 30.0)
    assert best.values["waveform.frequency_hz"] == 10.0
    assert worst.values["waveform.frequency_hz"] == 200.0
    assert ASYMMETRY.value(crossed.runs[0]) == pytest.approx(20.0)
