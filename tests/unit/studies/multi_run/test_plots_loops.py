"""Figures of loops."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilctl.studies.multi_run import plots_loops
from hilctl.studies.multi_run.collect import RunSeries


def drawn(panel):
    axes = Figure().subplots()
    panel.draw(axes)
    return axes


def labels(axes):
    return [line.get_label() for line in axes.lines]


def test_loops_by_each_number_at_values_of_the_others(crossed):
    sheets = {sheet.name: sheet for sheet in plots_loops.loop_sheets(crossed)}
    assert list(sheets) == ["loops_by_frequency", "loops_by_amplitude"]
    assert [panel.title for panel in sheets["loops_by_frequency"].panels] == ["3 A", "6 A"]
    axes = drawn(sheets["loops_by_frequency"].panels[0])
    assert labels(axes) == ["10 Hz", "100 Hz", "200 Hz"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("command, A", "displacement, µm")


def test_a_value_has_one_colour_in_all_panels(crossed):
    sheet = next(iter(plots_loops.loop_sheets(crossed)))
    colours = [[line.get_color() for line in drawn(panel).lines] for panel in sheet.panels]
    assert colours[0] == colours[1]


def test_before_and_after_of_the_same_settings(compensated):
    sheet = plots_loops.before_after_sheet(compensated)
    assert [panel.title for panel in sheet.panels] == ["1 Hz", "100 Hz"]
    axes = drawn(sheet.panels[1])
    assert labels(axes)[1:] == ["without compensator", "omega"]
    for line in axes.lines[1:]:
        assert (np.ptp(line.get_xdata()), np.ptp(line.get_ydata())) == pytest.approx((100, 100))


def test_runs_of_one_kind_have_no_before_and_after(crossed):
    assert plots_loops.before_after_sheet(crossed) is None
    assert plots_loops.error_sheet(crossed) is None
    assert plots_loops.model_sheet(crossed) is None
    assert plots_loops.minor_loop_sheet(crossed) is None


def test_errors_of_compensated_runs(compensated):
    sheet = plots_loops.error_sheet(compensated)
    axes = drawn(sheet.panels[0])
    assert labels(axes) == ["1 Hz", "100 Hz"]
    assert np.ptp(axes.lines[0].get_ydata()) == pytest.approx(80.0 * 2.0 * np.sin(0.01), rel=0.01)
    assert axes.get_ylabel() == "error, µm"


def test_a_run_alone_shows_its_error(compensated):
    alone = RunSeries("one", compensated.runs[2:3], ())
    assert len(plots_loops.error_sheet(alone).panels) == 1


def test_minor_loops_are_marked_within_the_cycle(make_run, make_digest):
    phase = np.linspace(0.0, 2.0 * np.pi, 400)
    wave = 4.0 * np.sin(phase) + 3.0 * np.sin(3.0 * phase)
    run = make_run(4.0, 20.0, digest=make_digest(loop=np.array((wave, 5.0 * wave))))
    run = replace(run, figures=replace(run.figures, minor_low_um=26.0))
    sheet = plots_loops.minor_loop_sheet(RunSeries("minor", (run,), tuple(run.values)))
    assert labels(drawn(sheet.panels[0])) == ["cycle", "minor loop", "minor loop"]


def test_the_model_s_error_stands_beside_its_loop(make_run, make_digest):
    modelled = np.array(([0.0, 1.0, 0.0], [0.0, 10.0, 0.0], [0.0, 9.0, 0.0]))
    digest = make_digest(modelled=modelled, model_error_percent=10.0)
    run = make_run(4.0, 20.0, digest=digest)
    axes = drawn(plots_loops.model_sheet(RunSeries("m", (run,), ())).panels[0])
    assert labels(axes) == ["measured", "model"]
    assert [text.get_text() for text in axes.texts] == ["error 10.0 %"]
