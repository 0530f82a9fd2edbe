"""Report pages and figures from Python."""

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl import api
from hilctl.base.errors import InputError
from tests.unit.api.test_recordings import file
from tests.unit.api.test_runs import SHORT, SINE

__all__ = ["file"]


@pytest.mark.slow
def test_figures_are_axes_and_files(file, tmp_path):
    settings = SHORT | {"waveform": SHORT["waveform"] | {"amplitude": 2.0}}
    other = api.run(SINE, tmp_path / "b.mcap", settings=settings, fast=True).path
    figures = api.figures([file, other], tmp_path / "figures", formats="svg")
    assert figures
    assert all(isinstance(each, Axes) for axes in figures.values() for each in axes)
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == set(figures)


def test_figures_of_one_recording_are_those_of_its_page(file, tmp_path, monkeypatch):
    pages, seen = [], {}
    monkeypatch.setattr("hilctl.lab.pages.html.figures", lambda sheets: pages.extend(sheets) or "")
    monkeypatch.setattr("hilctl.lab.studies.multi_run.plots.drawn", lambda sheet, width: Figure())
    page = tmp_path / "page.html"
    assert api.report_page(file, page) == api.summarize(file)
    figures = api.figures(file, tmp_path / "one", formats="svg", on_written=seen.__setitem__)
    assert [sheet.name for sheet in pages] == list(figures) == [path.stem for path in seen]
    assert [sheet.caption for sheet in pages] == list(seen.values())
    with pytest.raises(InputError, match="exists"):
        api.report_page(file, page)
