"""Selection and files of figures; trends."""

from dataclasses import replace

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.studies.multi_run import plots
from hilctl.lab.studies.multi_run.collect import RunSeries
from hilctl.lab.studies.multi_run.digest import RunValues
from tests.unit.lab.studies.multi_run.conftest import drawn, grown


def test_fits_are_drawn_along_frequency_only(crossed):
    sheets = {sheet.name: sheet for sheet in plots.trend_sheets(crossed)}
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


def test_what_compensators_leave_is_a_figure_of_its_own(compensated):
    sheets = {sheet.name: sheet for sheet in plots.trend_sheets(compensated)}
    assert list(sheets) == ["hysteresis_against_frequency", "compensation_against_frequency"]
    lines = drawn(sheets["compensation_against_frequency"].panels[0]).lines
    assert [line.get_label() for line in lines] == ["without compensator", "omega"]
    error = drawn(sheets["compensation_against_frequency"].panels[1]).lines
    # A compensator has one colour in all panels.
    assert error[0].get_color() == lines[1].get_color()


def test_they_are_found_from_what_varied(crossed, compensated):
    for series, names in (
        (crossed, "hysteresis_against_frequency hysteresis_against_amplitude loops_by_frequency "
                  "loops_by_amplitude"),
        (compensated, "before_and_after hysteresis_against_frequency "
                      "compensation_against_frequency loops_by_frequency "
                          "loops_by_frequency_against_reference"),
    ):  # fmt: skip
        assert [sheet.name for sheet in plots.sheets_of(series)] == names.split()


def test_resonances_of_steps_and_multisines():
    runs = []
    for number, natural_hz in enumerate((2300.0, 470.0), 1):
        figures = RunValues(natural_hz=natural_hz, damping_ratio=0.12)
        values = {"device.load_kg": 3.7 * number}
        runs.append(grown(1.0, 1.0, number, figures=figures, values=values, digest=None))
    series = RunSeries("loads", tuple(runs), ("device.load_kg",), is_campaign=True)
    (sheet,) = plots.sheets_of(series)
    assert sheet.name == "resonance_against_load"
    assert drawn(sheet.panels[0]).lines[0].get_ydata().tolist() == [2300.0, 470.0]


@pytest.mark.slow
def test_each_figure_is_a_file_of_each_format(crossed, tmp_path):
    few = replace(crossed, runs=crossed.runs[:3])
    folder = tmp_path / "figures"
    written = plots.write_sheets(
        plots.applying_sheets(few), folder, ["svg"], "single", overwrite=False
    )
    names = ["hysteresis_against_frequency.svg", "loops_by_frequency.svg"]
    assert [path.name for path in written] == names
    assert all(path.is_file() for path in written)
    assert all(caption.endswith(".") for caption in written.values())
    with pytest.raises(InputError, match="exists already"):
        plots.write_sheets(plots.applying_sheets(few), folder, ["svg"], "single", overwrite=False)


def test_no_figure_is_refused(crossed):
    planned = tuple(replace(run, result="planned", digest=None) for run in crossed.runs)
    for runs in ((), planned):
        with pytest.raises(InputError, match="no figure applies"):
            plots.applying_sheets(replace(crossed, runs=runs))
