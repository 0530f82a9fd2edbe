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
from hilctl.experiment.load import load_experiment, resolve
from hilctl.run.job import Job
from hilctl.run.loop_process import loaded_of
from hilctl.run.run_folder import run_folder
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture
def folder(tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        yield folder


def test_job_contains_the_checked_files(folder, tmp_path):
    """A model file may change between check and start; the checked one is used."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    (tmp_path / "link").symlink_to("configs")
    checked = checked_experiment(tmp_path / "link/demo.yaml", ["waveform.duration_s=1.0"])
    job = Job.of(checked, folder, locks=[5, 6], take_over=True, supervisor=7, silence_s=5.0)
    shutil.rmtree(tmp_path / "configs")
    job.write(folder.job)
    again = Job.read(folder.job)
    assert again == job
    loaded = loaded_of(again)
    assert loaded.config == checked.loaded.config
    assert loaded.model == checked.loaded.model
    assert loaded.device.info == checked.loaded.device.info
    reference, input_um = again.arrays()
    np.testing.assert_array_equal(reference, checked.reference.values)
    np.testing.assert_array_equal(input_um, checked.begun.input_um)
    assert (again.supervisor, again.silence_s, again.ring) == (7, 5.0, str(folder.ring))
    assert (again.holds, again.locks, again.take_over) == ([], [5, 6], True)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_experiment_is_restored_from_its_text(path):
    loaded = load_experiment(path)
    again = resolve(
        Document("experiment", loaded.yaml_text), loaded.folder, files=TextFiles(loaded.files.texts)
    )
    assert (again.config, again.model) == (loaded.config, loaded.model)
    assert again.device.info == loaded.device.info


def test_infinite_numbers_and_states_are_read_back(folder):
    checked = checked_experiment(CONFIGS / "demo.yaml", ["waveform.duration_s=1.0"])
    job = Job.of(checked, folder, locks=[], take_over=False, supervisor=1, silence_s=math.inf)
    job = replace(job, state=[0.1, -0.0, 1 / 3], adapted=[[math.inf, 0.1]])
    job.write(folder.job)
    assert Job.read(folder.job) == job


def test_input_equal_to_the_reference_is_stored_once(folder):
    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    job = Job.of(plain, folder, locks=[], take_over=False, supervisor=1, silence_s=1.0)
    assert (job.reference == job.input_um) == (plain.begun.input_um is plain.reference.values)
    assert (job.state is None) == (plain.begun.state is None)


def test_missing_memory_for_the_samples_is_reported(folder, monkeypatch):
    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    monkeypatch.setattr(np, "save", Mock(side_effect=OSError("8000 requested and 512 written")))
    with pytest.raises(RunError, match=r"recording\.ring_s"):
        Job.of(plain, folder, locks=[], take_over=False, supervisor=1, silence_s=1.0)
