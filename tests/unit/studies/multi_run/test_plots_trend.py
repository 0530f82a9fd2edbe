"""Figures of figures."""

from dataclasses import replace

import pytest
from matplotlib.figure import Figure

from hilctl.studies.multi_run import plots_trend
from hilctl.studies.multi_run.collect import RunSeries


def drawn(panel):
    axes = Figure().subplots()
    panel.draw(axes)
    return axes


def test_fits_are_drawn_along_frequency_only(crossed):
    sheets = {sheet.name: sheet for sheet in plots_trend.trend_sheets(crossed)}
    assert list(sheets) == ["hysteresis_against_frequency", "hysteresis_against_amplitude"]
    stroke, area, hysteresis = map(drawn, sheets["hysteresis_against_frequency"].panels)
    assert area.get_ylabel() == "loop area, µm·A"
    assert [text.get_text() for text in area.texts] == ["r² = 1.0000"]
    assert [line.get_label() for line in area.lines[::2]] == ["3 A", "6 A"]
    assert len(stroke.lines) == 2
    assert len(hysteresis.lines) == 4
    along_amplitude = sheets["hysteresis_against_amplitude"].panels
    assert all(not drawn(panel).texts for panel in along_amplitude)
    assert drawn(along_amplitude[3]).get_ylabel() == "asymmetry, %"


def test_points_are_never_cut_by_the_edge(crossed):
    sheet = next(iter(plots_trend.trend_sheets(crossed)))
    axes = drawn(sheet.panels[0])
    assert axes.get_ylim()[0] == 0.0
    assert axes.get_ylim()[1] > 60.0


def test_what_compensators_leave_is_a_figure_of_its_own(compensated):
    sheets = {sheet.name: sheet for sheet in plots_trend.trend_sheets(compensated)}
    assert list(sheets) == ["hysteresis_against_frequency", "compensation_against_frequency"]
    lines = drawn(sheets["compensation_against_frequency"].panels[0]).lines
    assert [line.get_label() for line in lines] == ["without compensator", "omega"]
    error = drawn(sheets["compensation_against_frequency"].panels[1]).lines
    # One compensator looks the same in every panel.
    assert error[0].get_color() == lines[1].get_color()


def test_sensitivity_is_the_change_over_the_range(crossed):
    sheet = plots_trend.sensitivity_sheet(crossed)
    axes = drawn(sheet.panels[0])
    sizes = {
        label.get_text().split("\n")[0]: bar.get_width()
        for label, bar in zip(axes.get_yticklabels(), axes.patches, strict=True)
    }
    assert sizes["amplitude"] == pytest.approx(100.0 * 30.0 / 45.0)
    assert sizes["frequency"] == pytest.approx(0.0)
    one = RunSeries("one", crossed.runs[:3], crossed.keys)
    assert plots_trend.sensitivity_sheet(one) is None


def test_reference_runs_are_marked_in_order(crossed):
    assert plots_trend.order_sheet(crossed) is None
    runs = [replace(run, is_reference=run.number in {1, 6}) for run in crossed.runs]
    sheet = plots_trend.order_sheet(replace(crossed, runs=tuple(runs)))
    axes = drawn(sheet.panels[0])
    assert [line.get_label() for line in axes.lines[:2]] == ["runs", "reference runs"]
    assert axes.lines[1].get_xdata().tolist() == [1, 6]


def test_resonances_against_what_varied(crossed):
    assert plots_trend.resonance_sheet(crossed) is None
    runs = [
        replace(run, figures=replace(run.figures, natural_hz=2300.0, damping_ratio=0.12))
        for run in crossed.runs
    ]
    sheet = plots_trend.resonance_sheet(replace(crossed, runs=tuple(runs)))
    assert [drawn(panel).get_ylabel() for panel in sheet.panels] == [
        "natural frequency, Hz",
        "damping ratio",
    ]
