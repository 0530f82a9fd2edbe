"""First experiments: accepted by the check, small, and explained."""

from pathlib import Path

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.experiment.load import load_axes, load_experiment
from hilctl.experiment.preflight import check
from hilctl.experiment.template import starting_device, starting_experiment
from hilctl_drivers.profile import FOLDER


def written(tmp_path, name, settings=(), **more):
    path = tmp_path / "mine.yaml"
    text, info = starting_experiment(starting_device(name, tmp_path, **more), path, settings)
    path.write_text(text)
    return check(load_experiment(path)), info, text


@pytest.mark.parametrize(("name", "more"), [
    ("simulated_terfenol", {}),
    ("simulated_piezo", {}),
    ("labjack_t7", {}),
    ("cobs_board_fifo", {}),
    ("kepco_bop", {"reader": "agilent_34970a"}),
    ("wago_750", {"unit": "V"}),
])  # fmt: skip
def test_it_may_start_and_is_small(tmp_path, name, more):
    checked, info, _ = written(tmp_path, name, **more)
    low, high = checked.loaded.config.limits.command_range
    span = info.command_max - info.command_min
    assert high - low <= 0.2 * span * (1.0 + 1e-9)
    assert checked.forecast.command_max <= high - 0.2 * (high - low)
    assert checked.loaded.config.compensator is None


def test_what_is_nobodys_says_so(tmp_path):
    _, _, text = written(tmp_path, "labjack_t7")
    for key in ("host:", "gain_a_per_v:", "um_per_v:", "peak_current_a:", "stroke_um:"):
        (line,) = (line for line in text.splitlines() if line.strip().startswith(key))
        assert "# set:" in line
    assert "show labjack_t7" in text


def test_settings_of_the_device_move_its_limits(tmp_path):
    settings = ["device.amplifier.gain_a_per_v=4", "device.amplifier.offset_a=-10", "name=rig"]
    checked, info, text = written(tmp_path, "labjack_t7", settings)
    assert (info.command_min, info.command_max) == (-10.0, 10.0)
    assert checked.loaded.config.limits.peak_current_a == 2.0
    assert checked.loaded.config.name == "rig"
    assert "gain_a_per_v: 4  # set:" in text


def test_settings_may_name_axes(tmp_path):
    path = tmp_path / "stage.yaml"
    seeds = ["axes.x.device.seed=1", "axes.y.device.seed=2"]
    text, _ = starting_experiment(starting_device("simulated_piezo", tmp_path, "V"), path, seeds)
    path.write_text(text)
    assert [each.config.device["seed"] for each in load_axes(path)] == [1, 2]


def test_an_own_profile_is_named_from_the_experiments_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own").mkdir()
    (tmp_path / "own" / "dac.yaml").write_text((FOLDER / "labjack_t7.yaml").read_text())
    folder = tmp_path / "rigs"
    folder.mkdir()
    path = folder / "mine.yaml"
    text, _ = starting_experiment(starting_device("own/dac.yaml", folder), path)
    path.write_text(text)
    assert load_experiment(path).document.data["device"]["profile"] == "../own/dac.yaml"


def test_all_broken_settings_are_told_at_once(tmp_path):
    device = starting_device("simulated_terfenol", tmp_path)
    settings = ["limits.peak_current_a=-1", "sample_rate_hz=fast", "nonsense"]
    with pytest.raises(ConfigError) as error:
        starting_experiment(device, tmp_path / "x.yaml", settings)
    assert "dotted.key=value" in str(error.value)
    with pytest.raises(ConfigError) as error:
        starting_experiment(device, tmp_path / "x.yaml", settings[:2])
    assert len(error.value.problems) == 2


@pytest.mark.parametrize(("name", "said"), [
    ("labjack_t77", "did you mean 'labjack_t7'"),
    ("modbus_dac", "takes a profile"),
    ("absent.yaml", "absent.yaml"),
])  # fmt: skip
def test_what_can_not_be_started_says_what_can(tmp_path, name, said):
    with pytest.raises(InputError, match=said):
        starting_device(name, tmp_path)


@pytest.mark.parametrize(("name", "settings", "reader", "high"), [
    ("labjack_t7", ["device.amplifier={gain_a_per_v: 2}"], None, 2.0),
    ("tdk_lambda_gen", [], "agilent_34970a", 7.6),
])  # fmt: skip
def test_a_current_of_one_sign_has_a_range(tmp_path, name, settings, reader, high):
    """A limit of both signs would leave no current at all."""
    checked, _, _ = written(tmp_path, name, settings, reader=reader)
    limits = checked.loaded.config.limits
    assert limits.drive_a == limits.command_range == (0.0, high)


def test_a_sensor_that_sends_unasked_may_be_late(tmp_path):
    checked, _, _ = written(tmp_path, "bk_precision_1785b", (), reader="capancdt_6200")
    config = checked.loaded.config
    assert config.limits.sensor_invalid_s * config.sample_rate_hz == pytest.approx(3.0)


def test_a_range_that_begins_a_little_below_zero_is_moved_about_its_middle(tmp_path):
    settings = ["device.amplifier.gain_v_per_v=10"]
    checked, _, _ = written(tmp_path, "labjack_t8", settings, unit="V")
    low, high = checked.loaded.config.limits.command_range
    assert -1.0 < low < 0.0
    waveform = checked.loaded.config.waveform
    assert waveform.offset == pytest.approx(0.5 * (low + high))
    assert waveform.amplitude > 0.2 * (high - low)
