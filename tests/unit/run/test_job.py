"""The job: the loop process gets exactly the checked experiment."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from hilctl.base.errors import RunError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment.load import load_axes, resolve
from hilctl.run.job import Job
from hilctl.run.loop_process import loaded_of
from hilctl.run.run_folder import run_folder
from hilctl.run.start import checked_run

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture
def folder(tmp_path):
    with run_folder("demo", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        yield folder


def test_job_contains_the_checked_files(folder, tmp_path):
    """A model file may change between check and start; the checked one is used."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    (tmp_path / "link").symlink_to("configs")
    checked = checked_run(tmp_path / "link/demo.yaml", ["waveform.duration_s=1.0"])
    job = Job.of(checked, folder, locks=[5, 6], take_over=True, supervisor=7, silence_s=5.0)
    shutil.rmtree(tmp_path / "configs")
    job.write(folder.job)
    again = Job.read(folder.job)
    assert again == job
    (axis,), first = again.axes, checked.first
    loaded = loaded_of(axis)
    assert loaded.config == first.loaded.config
    assert loaded.model == first.loaded.model
    assert loaded.device.info == first.loaded.device.info
    reference, input_um = axis.arrays()
    np.testing.assert_array_equal(reference, first.reference.values)
    np.testing.assert_array_equal(input_um, first.begun.input_um)
    assert (again.supervisor, again.silence_s, axis.ring) == (7, 5.0, str(folder.ring))
    assert (again.holds, again.locks, again.take_over) == ([], [5, 6], True)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_experiment_is_restored_from_its_text(path):
    for loaded in load_axes(path):
        document, files = Document("experiment", loaded.yaml_text), TextFiles(loaded.files.texts)
        again = resolve(document, loaded.folder, files=files)
        assert (again.config, again.model) == (loaded.config, loaded.model)
        assert again.device.info == loaded.device.info


def test_infinite_numbers_and_states_are_read_back(folder):
    checked = checked_run(CONFIGS / "demo.yaml", ["waveform.duration_s=1.0"])
    job = Job.of(checked, folder, locks=[], take_over=False, supervisor=1, silence_s=math.inf)
    axis = replace(job.axes[0], state=[0.1, -0.0, 1 / 3], adapted=[[math.inf, 0.1]])
    job = replace(job, axes=[axis])
    job.write(folder.job)
    assert Job.read(folder.job) == job


def test_input_equal_to_the_reference_is_stored_once(folder):
    plain = checked_run(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    job = Job.of(plain, folder, locks=[], take_over=False, supervisor=1, silence_s=1.0)
    (axis,), first = job.axes, plain.first
    assert (axis.reference == axis.input_um) == (first.begun.input_um is first.reference.values)
    assert (axis.state is None) == (first.begun.state is None)


def test_missing_memory_for_the_samples_is_reported(folder, monkeypatch):
    plain = checked_run(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    monkeypatch.setattr(np, "save", Mock(side_effect=OSError("8000 requested and 512 written")))
    with pytest.raises(RunError, match=r"recording\.ring_s"):
        Job.of(plain, folder, locks=[], take_over=False, supervisor=1, silence_s=1.0)
