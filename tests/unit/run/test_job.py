"""What the supervisor hands to the loop's process: the same experiment, and nothing from disk."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import RunError
from hilctl.run.job import DeviceText, Job
from hilctl.run.run_folder import run_folder
from hilctl.run.start import checked_experiment
from hilctl.run.waiting_loop import CHECKING, PLAIN

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
    assert folder.description.exists()  # who looks on finds it before the first sample
    sent = job.to_bytes()
    assert sent.startswith(PLAIN)
    again = Job.from_bytes(sent)
    parts = again.parts()
    assert parts.config == checked.loaded.config
    assert parts.model == checked.loaded.model
    assert parts.device.info == checked.loaded.device.info
    reference, input_um = again.arrays()
    np.testing.assert_array_equal(reference, checked.reference.values)
    np.testing.assert_array_equal(input_um, checked.begun.input_um)
    assert (again.supervisor, again.silence_s, again.ring) == (7, 5.0, folder.ring)


def test_an_input_that_is_the_reference_is_kept_once(folder):
    """Without a correction or a preview both are one file; the memory before the run goes along."""
    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    job = Job.of(plain, folder, supervisor=1, silence_s=1.0)
    assert (job.reference == job.input_um) == (plain.begun.input_um is plain.reference.values)
    assert (job.state is None) == (plain.begun.state is None)


def test_samples_that_find_no_room_are_told(folder, monkeypatch):
    """With what needs less of it: numpy gives no reason of its own."""

    def save(path, values):
        raise OSError("8000 requested and 512 written")

    plain = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    monkeypatch.setattr(np, "save", save)
    with pytest.raises(RunError, match=r"npy: no memory: 8000 requested and 512 written; less rec"):
        Job.of(plain, folder, supervisor=1, silence_s=1.0)


@pytest.mark.parametrize("of_others", [False, True])
def test_a_device_that_is_not_sent_is_made_from_what_was_checked(
    folder, tmp_path, monkeypatch, of_others
):
    """A port that is polled stays in its process; other people's devices may count on checks."""
    file = "demo.yaml" if of_others else "serial_cobs_fifo.yaml"
    shutil.copytree(CONFIGS, tmp_path / "configs")
    checked = checked_experiment(tmp_path / "configs" / file, ["waveform.duration_s=1.0"])
    device = checked.loaded.device
    if of_others:
        monkeypatch.setattr(type(device), "__module__", "a_lab.rig")
    job = Job.of(checked, folder, supervisor=1, silence_s=1.0)
    shutil.rmtree(tmp_path / "configs")
    assert isinstance(job.device, DeviceText)
    sent = job.to_bytes()
    assert sent.startswith(CHECKING)
    made = Job.from_bytes(sent).parts().device
    assert type(made) is type(device)
    assert made.info == device.info
