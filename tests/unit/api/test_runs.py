"""What moves an actuator, from Python: what it takes, what it returns, what it refuses."""

from pathlib import Path

import pytest

from hilctl import api
from hilctl.base.errors import ConfigError, InputError

CONFIGS = Path(__file__).parents[3] / "configs"
SINE = CONFIGS / "terfenol_sine_6a_uncompensated.yaml"
SHORT = {
    "sample_rate_hz": 5000,
    "block": 10,
    "waveform": {
        "kind": "sine", "unit": "A", "amplitude": 1.0, "frequency_hz": 50.0, "duration_s": 0.2,
    },
}  # fmt: skip


def test_an_experiment_is_run_and_recorded(tmp_path):
    """Settings go over the file by their keys, whatever their values are."""
    result = api.run(SINE, tmp_path / "a.mcap", settings=SHORT, fast=True)
    assert (result.code, result.path) == ("completed", tmp_path / "a.mcap")
    assert api.read(result.path).recording.sample_rate_hz == 5000.0
    with pytest.raises(InputError, match=r"a\.mcap: exists"):
        api.run(SINE, tmp_path / "a.mcap", settings=SHORT, fast=True)
    api.run(str(SINE), str(tmp_path / "a.mcap"), settings=SHORT, fast=True, overwrite=True)


def test_without_a_name_it_goes_to_the_folder_of_the_experiment(tmp_path):
    settings = SHORT | {"recording.folder": str(tmp_path / "runs")}
    result = api.run(SINE, settings=settings, fast=True)
    assert result.path.parent == tmp_path / "runs"
    assert api.list_runs(tmp_path)[0]["name"] == "terfenol_sine_6a_uncompensated"


def test_an_experiment_is_loaded_and_checked():
    """Settings may be texts, as the command line has them."""
    assert api.load(SINE, ["waveform.amplitude=2.5"]).config.waveform.amplitude == 2.5
    assert api.check(SINE, SHORT).forecast.samples == 1000
    with pytest.raises(ConfigError) as refused:
        api.check(SINE, {"sample_rate_hz": -1, "block": 0})
    assert len(str(refused.value).splitlines()) == 2


def test_a_real_device_does_not_run_fast(tmp_path):
    with pytest.raises(InputError, match="only a simulated device can run without real time"):
        api.run(CONFIGS / "serial_scpi_kepco.yaml", tmp_path / "a.mcap", fast=True)
    assert not [*tmp_path.iterdir()]


def test_a_real_run_goes_the_way_of_the_command(monkeypatch, tmp_path):
    """It keeps real time, in processes of its own."""
    monkeypatch.setattr("hilctl.api.runs.start_run", lambda *given: given)
    seen = print
    given = api.run(SINE, settings={"block": 5}, overwrite=True, on_progress=seen)
    assert given == (SINE, ["block=5"], None, True, seen)


@pytest.mark.slow
def test_learning_keeps_its_runs_and_writes_a_correction(tmp_path):
    rows = []
    settings = {
        "sample_rate_hz": 10000, "block": 10, "waveform.duration_s": 0.4,
        "waveform.frequency_hz": 50.0, "waveform.soft_start_s": 0.1, "waveform.soft_end_s": 0.1,
    }  # fmt: skip
    file = tmp_path / "c.yaml"
    learned = api.learn(
        CONFIGS / "terfenol_sine_6a.yaml", file, cycles=1, settings=settings, fast=True,
        on_rows=rows.extend,
    )  # fmt: skip
    assert learned.rows[1].error_percent < learned.rows[0].error_percent
    assert len(rows) >= 2
    assert file.exists()
    assert (tmp_path / "c-runs" / "run-00.mcap").exists()
    with pytest.raises(InputError, match="exists"):
        api.learn(SINE, file, fast=True)
    with pytest.raises(InputError, match="holds runs already"):
        api.learn(SINE, tmp_path / "c.yml", folder=tmp_path / "c-runs", fast=True)
