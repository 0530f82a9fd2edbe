"""Recordings from Python: tables with units, figures, what is found."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl import api
from hilctl.base.errors import DataError, InputError
from tests.unit.api.test_runs import SHORT, SINE


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A recording of 0.2 s."""
    settings = SHORT | {"labels": {"sample": "A7"}}
    output = tmp_path_factory.mktemp("api") / "a.mcap"
    return api.run(SINE, output, settings=settings, fast=True).path


def test_a_table_has_named_columns_with_units(file):
    run = api.read(file)
    table = run.table
    assert list(table)[:2] == ["sample", "t_s"]
    assert {"t_s": "s", "current_a": "A", "displacement_um": "um"}.items() <= table.units.items()
    assert set(table.units) <= set(table)
    assert (
        {each.size for each in table.values()} == {table.rows} == {run.recording.samples.index.size}
    )
    np.testing.assert_array_equal(table["displacement_um"], run.recording.samples.displacement_um)
    assert "displacement_um [um]" in repr(table)
    assert (run.labels, run.path) == ({"sample": "A7"}, file)
    assert run.facts["code"] == "completed"


def test_a_stretch_is_read(file):
    run = api.read(file, from_s=0.05, to_s=0.1)
    assert run.table["t_s"].min() >= 0.05
    assert run.table["t_s"].max() < 0.1
    with pytest.raises(InputError, match="give them to read"):
        api.export(run, file.with_suffix(".csv"), from_s=0.0)


def test_a_file_and_what_was_read_of_it_give_the_same(file, tmp_path):
    run = api.read(file)
    assert api.summarize(run) == api.summarize(file)
    assert api.replay(run).identical
    assert api.replay(str(file)).identical
    assert api.export(run, tmp_path / "a.csv") == api.export(file, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.slow
def test_figures_are_axes_and_files(file, tmp_path):
    settings = SHORT | {"waveform": SHORT["waveform"] | {"amplitude": 2.0}}
    other = api.run(SINE, tmp_path / "b.mcap", settings=settings, fast=True).path
    figures = api.figures([file, other], tmp_path / "figures", formats="svg")
    assert figures
    assert all(isinstance(each, Axes) for axes in figures.values() for each in axes)
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == set(figures)


def test_what_is_found_is_a_list(file):
    (found,) = api.list_runs(file.parent, where='label.sample == "A7"')
    assert found["labels"] == {"sample": "A7"}
    assert api.list_runs(file.parent, where="waveform.amplitude > 3") == []


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no")
    with pytest.raises(DataError):
        api.read(tmp_path / "x.mcap")
    with pytest.raises(InputError):
        api.summarize(tmp_path / "y.mcap")


def test_figures_of_one_recording_are_those_of_its_page(file, tmp_path, monkeypatch):
    pages, seen = [], {}
    monkeypatch.setattr("hilctl.analysis.html.figures", lambda sheets: pages.extend(sheets) or "")
    monkeypatch.setattr("hilctl.studies.multi_run.plots.drawn", lambda sheet, width: Figure())
    page = tmp_path / "page.html"
    assert api.report_page(file, page) == api.summarize(file)
    figures = api.figures(file, tmp_path / "one", formats="svg", on_written=seen.__setitem__)
    assert [sheet.name for sheet in pages] == list(figures) == [path.stem for path in seen]
    assert [sheet.caption for sheet in pages] == list(seen.values())
    with pytest.raises(InputError, match="exists already"):
        api.report_page(file, page)


def test_a_stretch_is_judged(file):
    whole, part = api.summarize(file), api.summarize(file, from_s=0.1, to_s=0.2)
    assert part.samples < whole.samples


def test_dead_runs_are_finished_before_anything_is_read(file, monkeypatch):
    finished = []
    monkeypatch.setattr("hilctl.api.recordings.finish_dead_runs", lambda: finished.append(True))
    for act in (api.read, api.summarize, api.replay):
        act(file)
    assert len(finished) == 3
