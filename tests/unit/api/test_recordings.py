"""Read, evaluate, plot and export recordings from Python."""

import numpy as np
import pytest

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
    sizes = {each.size for each in table.values()}
    assert sizes == {table.rows} == {run.recording.samples.index.size}
    np.testing.assert_array_equal(table["displacement_um"], run.recording.samples.displacement_um)
    assert "displacement_um [um]" in repr(table)
    assert repr(run) == f"<{run.path}: {table!r}>"
    assert (run.labels, run.path) == ({"sample": "A7"}, file)
    assert run.facts["code"] == "completed"


def test_a_time_range_is_read(file):
    run = api.read(file, from_s=0.05, to_s=0.1)
    assert 0.05 <= run.table["t_s"].min() < run.table["t_s"].max() < 0.1
    assert api.summarize(file, from_s=0.1, to_s=0.2).samples < api.summarize(file).samples
    with pytest.raises(InputError, match="read"):
        api.export(run, file.with_suffix(".csv"), from_s=0.0)


def test_a_file_and_its_recording_in_memory_give_the_same(file, tmp_path):
    run = api.read(file)
    assert api.summarize(run) == api.summarize(file)
    assert api.replay(run).identical
    assert api.replay(str(file)).identical
    assert api.export(run, tmp_path / "a.csv") == api.export(file, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_the_catalogue_is_a_list(file):
    (found,) = api.list_runs(file.parent, where='label.sample == "A7"')
    assert found["labels"] == {"sample": "A7"}
    assert api.list_runs(file.parent, where="waveform.amplitude > 3") == []


def test_other_files_are_refused(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no")
    with pytest.raises(DataError):
        api.read(tmp_path / "x.mcap")
    with pytest.raises(InputError):
        api.summarize(tmp_path / "y.mcap")
