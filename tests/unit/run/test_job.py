"""What the supervisor hands to the loop's process: the same experiment, and nothing from disk."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import RunError
from hilctl.run.job import Job
from hilctl.run.run_folder import run_folder
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture
def folder(tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        yield folder


def test_the_job_is_what_was_checked_even_where_its_files_have_gone(folder, tmp_path):
    """Between the check and the start a model file may change: the run is the checked one."""
    shutil.copy(CONFIGS / "demo.yaml", tmp_path)
    shutil.copytree(CONFIGS / "models", tmp_path / "models")
    checked = checked_experiment(tmp_path / "demo.yaml", ["waveform.duration_s=1.0"])
    job = Job.of(checked, folder, supervisor=7, silence_s=5.0)
    shutil.rmtree(tmp_path / "models")
    (tmp_path / "demo.yaml").unlink()
    again = Job.from_json(job.to_json())
    assert again == job
    loaded = again.load()
    assert loaded.config == checked.loaded.config
    assert loaded.model == checked.loaded.model
    reference, input_um = again.arrays()
    np.testing.assert_array_equal(reference, checked.reference.values)
    np.testing.assert_array_equal(input_um, checked.begun.input_um)
    assert (again.supervisor, again.silence_s, again.ring_path) == (7, 5.0, folder.ring)


def test_an_input_that_is_the_reference_is_kept_once(folder):
    """Without a correction or a preview both are one file; the memory before the run goes along."""
    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    job = Job.of(plain, folder, supervisor=1, silence_s=1.0)
    assert (job.reference == job.input_um) == (plain.begun.input_um is plain.reference.values)
    assert job.memory is None if plain.begun.state is None else job.memory is not None


def test_samples_that_find_no_room_are_told(folder, monkeypatch):
    """With what needs less of it: numpy gives no reason of its own."""

    def save(path, values):
        raise OSError("8000 requested and 512 written")

    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    monkeypatch.setattr(np, "save", save)
    with pytest.raises(RunError, match=r"npy: no memory: 8000 requested and 512 written; less rec"):
        Job.of(plain, folder, supervisor=1, silence_s=1.0)
