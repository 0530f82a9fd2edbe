"""Trends of metrics and the headline."""

from dataclasses import replace

import pytest

from hilctl.studies.multi_run.trend import (
    AREA,
    ASYMMETRY,
    HYSTERESIS,
    STROKE,
    extremes,
    headline,
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
    assert extremes(AREA, few) is None


def test_extremes_and_asymmetry(crossed):
    (best, low), (worst, high) = extremes(HYSTERESIS, crossed.runs)
    assert (low, high) == (11.0, 30.0)
    assert best.values["waveform.frequency_hz"] == 10.0
    assert worst.values["waveform.frequency_hz"] == 200.0
    assert ASYMMETRY.value(crossed.runs[0]) == pytest.approx(20.0)


def test_best_worst_and_trends_of_loops(crossed):
    runs, hysteresis, frequency, area, amplitude = headline(crossed)
    assert runs.startswith("6 runs")
    assert "11.0 % (10 Hz, 3 A)" in hysteresis
    assert "30.0 % (200 Hz, 3 A)" in hysteresis
    assert "hysteresis rises" in frequency
    assert "r² 1.0000" in area
    assert "peak-to-peak rises" in amplitude


def test_failures_come_first(crossed):
    broken = replace(crossed.runs[2], result="fault: the coil is hot")
    later = replace(crossed.runs[5], result="planned")
    series = replace(crossed, runs=(*crossed.runs[:2], broken, *crossed.runs[3:5], later))
    first = headline(series)[0]
    assert first.startswith("4 of 6 runs")
    assert "1 failed: 200 Hz, 3 A (fault: the coil is hot)" in first


def test_before_and_after(compensated):
    text = " ".join(headline(compensated))
    assert "20.0 to 21.0 %, worst at 100 Hz" in text
    assert "omega 2.01 to 3.00 %" in text


def test_resonances(crossed):
    runs = [
        replace(run, figures=replace(run.figures, natural_hz=2300.0 / n, damping_ratio=0.12))
        for n, run in enumerate(crossed.runs, 1)
    ]
    text = " ".join(headline(replace(crossed, runs=tuple(runs))))
    assert "383 Hz (200 Hz, 6 A) to 2300 Hz" in text
