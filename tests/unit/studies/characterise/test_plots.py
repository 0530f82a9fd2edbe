"""Figures: what is left out is not bridged, and all groups are drawn."""

from dataclasses import replace

import numpy as np

from hilctl.studies.characterise.loops import ReversalCurves
from hilctl.studies.characterise.plots import (
    held_out_figure,
    loops_figure,
    response_figure,
    reversal_figure,
)
from hilctl.studies.characterise.response import SmallSignal
from tests.unit.studies.characterise.test_results import LOOP, UNSEEN

HZ = np.geomspace(10.0, 1000.0, 30)
SMALL = SmallSignal(
    HZ, 4.0 / (1.0 + 1j * HZ / 300.0), np.full(30, 0.1), 0.2, 4.0, 1e-4, 5e-4, 700.0, 0.1, 1.0,
    4.0 / (1.0 + 1j * HZ / 300.0),
)  # fmt: skip


def test_the_response_shows_band_and_resonance():
    upper, lower = response_figure(SMALL, (1.0, 50.0), "A").axes
    assert upper.get_ylabel() == "µm/A"
    assert any(np.allclose(line.get_xdata(), 700.0) for line in upper.lines)
    np.testing.assert_allclose(lower.lines[1].get_ydata()[-1], np.degrees(-np.arctan(1000 / 300)))
    assert len(response_figure(replace(SMALL, natural_hz=None), (1.0, 50.0), "A").axes) == 2


def test_groups_without_loops_get_no_panel():
    loop = replace(LOOP, command=np.arange(4.0), displacement_um=np.arange(4.0))
    figure = loops_figure([("growing", [loop] * 20), ("slow", []), ("biased", [loop])], "A")
    shown = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert shown == ["growing", "biased"]
    assert len(figure.axes[0].lines) == 20


def test_reversal_curves_are_drawn_against_the_outer_one():
    line = np.linspace(-1.0, 1.0, 50)
    curves = (np.array((line, 2.0 * line)), np.array((line[25:], 2.0 * line[25:] + 0.5)))
    _, right = reversal_figure(ReversalCurves((-1.0, 0.0), curves, 0.0, 0.0), "A").axes
    np.testing.assert_allclose(right.lines[0].get_ydata(), 0.0, atol=1e-12)
    np.testing.assert_allclose(right.lines[1].get_ydata(), 0.5)


def test_what_was_not_judged_is_a_gap():
    time_s = np.concatenate((np.arange(100), np.arange(300, 400))) / 1000.0
    found = replace(UNSEEN, time_s=time_s, measured_um=time_s, modelled_um=time_s + 0.5)
    upper, lower = held_out_figure(found, close=False).axes
    assert np.isnan(lower.lines[0].get_ydata()).sum() == 1
    assert upper.lines[0].get_xdata().size == 201
    close, _ = held_out_figure(found, close=True).axes
    assert close.lines[0].get_xdata().size < 50
