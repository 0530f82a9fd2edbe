"""Loops of runs side by side."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from hilctl.lab.pages.plot_style import WITH, WITHOUT
from hilctl.lab.studies.multi_run.collect import RunSeries
from hilctl.lab.studies.multi_run.run_plots import (
    before_after_sheet,
    looks,
    loop_sheets,
    model_sheet,
    spread,
)
from hilctl.lab.studies.multi_run.varied_parameter import WITHOUT_COMPENSATOR, VariedParameter
from tests.unit.lab.studies.multi_run.conftest import digest, drawn, grown

AMPLITUDE = VariedParameter("a", "amplitude", "A", (1.0, 2.0, 3.0))


def lightness(colour):
    return sum(w * c for w, c in zip((0.21, 0.72, 0.07), to_rgb(colour), strict=True))


def test_numbers_keep_their_order_in_grey():
    found = looks(AMPLITUDE, AMPLITUDE.values)
    shades = [lightness(found[value]["color"]) for value in AMPLITUDE.values]
    assert shades == sorted(shades)
    assert shades[2] - shades[0] > 0.35


def test_names_have_colours_and_signs_of_their_own():
    found = looks(None, ["none", "b", "c"])
    assert len({look["color"] for look in found.values()}) == 3
    assert len({look["marker"] for look in found.values()}) == 3


def test_runs_without_a_compensator_look_as_on_the_page_of_a_single_run():
    kinds = VariedParameter("compensator", "compensator", "", ("none", "a", "b"))
    for found, plain in (
        (looks(kinds, kinds.values), "none"),
        (looks(None, [WITHOUT_COMPENSATOR, "a", "b"]), WITHOUT_COMPENSATOR),
    ):
        assert (found[plain]["color"], found["a"]["color"]) == (WITHOUT, WITH)
        assert found["b"]["color"] not in {WITHOUT, WITH}


def test_many_are_spread_with_both_ends():
    assert spread(list(range(20)), 4) == [0, 6, 13, 19]
    assert spread([1, 2], 7) == [1, 2]


def labels(axes):
    return [line.get_label() for line in axes.lines]


def test_loops_by_each_number_at_values_of_the_others(crossed):
    sheets = {sheet.name: sheet for sheet in loop_sheets(crossed)}
    assert list(sheets) == ["loops_by_frequency", "loops_by_amplitude"]
    assert [panel.title for panel in sheets["loops_by_frequency"].panels] == ["3 A", "6 A"]
    axes = drawn(sheets["loops_by_frequency"].panels[0])
    assert labels(axes) == ["10 Hz", "100 Hz", "200 Hz"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("command, A", "displacement, µm")


def test_a_caption_counts_the_loops_and_panels_that_are_left_out():
    runs = [grown(float(a), hz) for a in range(1, 10) for hz in (10.0, 100.0)]
    many = RunSeries("loops", tuple(runs), tuple(runs[0].values), is_campaign=True)
    sheets = {sheet.name: sheet.caption for sheet in loop_sheets(many)}
    assert "6 of 9" in sheets["loops_by_frequency"]
    assert "7 of 9" in sheets["loops_by_amplitude"]


def test_a_value_has_one_colour_in_all_panels(crossed):
    sheet = next(iter(loop_sheets(crossed)))
    colours = [[line.get_color() for line in drawn(panel).lines] for panel in sheet.panels]
    assert colours[0] == colours[1]


def test_before_and_after_of_the_same_settings(compensated):
    sheet = before_after_sheet(compensated)
    assert [panel.title for panel in sheet.panels] == ["1 Hz", "100 Hz"]
    axes = drawn(sheet.panels[1])
    assert labels(axes)[1:] == ["without compensator", "omega"]
    for line in axes.lines[1:]:
        assert (np.ptp(line.get_xdata()), np.ptp(line.get_ydata())) == pytest.approx((100, 100))


def test_runs_of_one_kind_have_no_before_and_after(crossed):
    for sheet in (before_after_sheet, model_sheet):
        assert sheet(crossed) is None


def test_the_model_s_error_stands_beside_its_loop():
    modelled = np.array(([0.0, 1.0, 0.0], [0.0, 10.0, 0.0], [0.0, 9.0, 0.0]))
    made = digest(modelled=modelled, model_error_percent=10.0)
    run = grown(4.0, 20.0, digest=made)
    axes = drawn(model_sheet(RunSeries("m", (run,), ())).panels[0])
    assert labels(axes) == ["measured", "model"]
    assert [text.get_text() for text in axes.texts] == ["error 10.0 %"]
