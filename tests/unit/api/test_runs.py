"""Write, load, check and run experiments from Python."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilctl import api
from hilctl.base.errors import ConfigError, InputError

CONFIGS = Path(__file__).parents[3] / "configs"
SINE = CONFIGS / "terfenol_sine_6a_uncompensated.yaml"
SHORT = {
    "sample_rate_hz": 5000, "block": 10,
    "waveform": {
        "kind": "sine", "unit": "A", "amplitude": 1.0, "frequency_hz": 50.0, "duration_s": 0.2,
    },
}  # fmt: skip


def test_an_experiment_is_run_and_recorded(tmp_path):
    result = api.run(SINE, tmp_path / "a.mcap", settings=SHORT, fast=True)
    assert (result.code, result.path) == ("completed", tmp_path / "a.mcap")
    assert api.read(result.path).recording.sample_rate_hz == 5000.0
    with pytest.raises(InputError, match=r"a\.mcap: exists"):
        api.run(SINE, tmp_path / "a.mcap", settings=SHORT, fast=True)
    api.run(str(SINE), str(tmp_path / "a.mcap"), settings=SHORT, fast=True, overwrite=True)


def test_the_default_output_is_in_the_folder_of_the_experiment(tmp_path):
    settings = SHORT | {"recording.folder": str(tmp_path / "runs")}
    result = api.run(SINE, settings=settings, fast=True)
    assert result.path.parent == tmp_path / "runs"
    assert api.list_runs(tmp_path)[0]["name"] == "terfenol_sine_6a_uncompensated"


@pytest.mark.parametrize("use", [api.run, api.check, api.check_axes, api.load])
def test_a_mapping_is_no_experiment(use):
    with pytest.raises(InputError, match="path of a file, got dict"):
        use({"name": "x"})


@pytest.mark.parametrize("fast", [False, True])
def test_a_recording_is_an_mcap_file(tmp_path, fast):
    with pytest.raises(InputError, match=r"\.mcap"):
        api.run(SINE, tmp_path / "out.csv", fast=fast)
    assert not [*tmp_path.iterdir()]


def test_an_experiment_is_loaded_and_checked():
    assert api.load(SINE, ["waveform.amplitude=2.5"]).config.waveform.amplitude == 2.5
    assert api.check(SINE, SHORT).forecast.samples == 1000
    with pytest.raises(ConfigError) as refused:
        api.check(SINE, {"sample_rate_hz": -1, "block": 0})
    assert len(str(refused.value).splitlines()) == 2


def test_a_real_device_does_not_run_fast(tmp_path):
    with pytest.raises(InputError, match="simulated"):
        api.run(CONFIGS / "serial_scpi_kepco.yaml", tmp_path / "a.mcap", fast=True)
    assert not [*tmp_path.iterdir()]


def test_init_writes_a_valid_experiment(tmp_path):
    written = api.init("simulated_piezo", tmp_path / "first.yaml", settings={"safe.ramp_s": 2.0})
    assert (written.path, written.to_be_set) == (tmp_path / "first.yaml", {})
    assert written.schema.is_file()
    checked = api.check(written.path)
    assert checked.loaded.config.safe.ramp_s == 2.0
    assert checked.loaded.device.info == written.device


def test_init_lists_the_values_to_be_set(tmp_path):
    given = {"device.host": "10.0.0.5", "device.amplifier": {"gain_a_per_v": 2.0, "offset_a": -5.0}}
    written = api.init("labjack_t7", tmp_path / "rig.yaml", settings=given)
    assert "device.sensor.um_per_v" in written.to_be_set
    assert not {"device.host", "device.amplifier.gain_a_per_v"} & set(written.to_be_set)


def test_init_refuses_invalid_settings_and_existing_files(tmp_path):
    with pytest.raises(InputError, match="within"):
        api.init("simulated_piezo", tmp_path / "a.yaml", settings=["limits.drive_v=[0, 5000]"])
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.yaml").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        api.init("simulated_piezo", tmp_path / "a.yaml")
    assert (tmp_path / "a.yaml").read_text() == "mine"


PROGRAM = f"""
import os
before = dict(os.environ)
access, os.access = os.access, lambda *_: False  # no folder for kernels
from hilctl import api
api.load({str(SINE)!r})
api.read, api.identify
from hilctl.kernels import jit
jit._numba()
assert os.environ == before, set(os.environ.items()) ^ set(before.items())
"""


def test_a_program_keeps_its_environment():
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OPENBLAS", "NUMBA"))}
    ended = subprocess.run([sys.executable, "-c", PROGRAM], env=kept, capture_output=True)
    assert ended.returncode == 0, ended.stderr.decode()
