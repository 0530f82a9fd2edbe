"""Trends of metrics."""

from dataclasses import replace

import pytest

from hilctl.lab.studies.multi_run.trend import (
    AREA,
    ASYMMETRY,
    STROKE,
    trends,
)


def by_name(series):
    return {each.name: each for each in series.dimensions}


def test_a_line_is_fitted_for_all_values_of_the_others(crossed):
    found = trends(crossed, AREA, by_name(crossed)["frequency"])
    assert [trend.held for trend in found] == [{"waveform.amplitude": a} for a in (3.0, 6.0)]
    for trend, expected in zip(found, ((1.5, 60.0, 1.0), (3.0, 120.0, 1.0)), strict=True):
        assert (trend.slope, trend.offset, trend.r2) == pytest.approx(expected)
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
    along = by_name(crossed)["amplitude"]
    found = trends(crossed, AREA, along, [*crossed.runs, *crossed.runs])
    assert len(found) == 3
    assert all(trend.r2 is None and trend.x.size == 2 for trend in found)


def test_what_a_run_has_not_is_left_out(crossed):
    few = [replace(run, figures=replace(run.figures, loop_area=None)) for run in crossed.runs]
    assert trends(crossed, AREA, by_name(crossed)["frequency"], few) == []


def test_asymmetry(crossed):
    assert ASYMMETRY.value(crossed.runs[0]) == pytest.approx(20.0)
