"""Experiments with what their device section refers to."""

from pathlib import Path

import pytest
import yaml

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.experiment.load import load_experiment, resolve

PROFILE = (Path(__file__).parents[2] / "data" / "rtu_module.yaml").read_text(encoding="utf-8")
DEVICE = {
    "kind": "modbus_dac",
    "profile": "mine/module.yaml",
    "serial_port": "/dev/ttyNOWHERE",
    "output": "OUT",
    "input": "IN",
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
EXPERIMENT = {
    "name": "profiles",
    "sample_rate_hz": 50,
    "waveform": {"kind": "hold", "unit": "A", "level": 0.0, "duration_s": 1.0},
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": 0.2},
}


@pytest.fixture
def written(tmp_path):
    """Return a function that writes an experiment, and a profile below its folder."""

    def write(text=PROFILE, **device):
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "module.yaml").write_text(text, encoding="utf-8")
        path = tmp_path / "experiment.yaml"
        experiment = {**EXPERIMENT, "device": {**DEVICE, **device}}
        path.write_text(yaml.safe_dump(experiment, sort_keys=False), encoding="utf-8")
        return path

    return write


def test_profiles_are_found_from_the_experiments_folder(written, tmp_path, monkeypatch):
    path = written()
    monkeypatch.chdir("/")
    assert load_experiment(path).device.info.details["profile"] == "mine/module.yaml"


def test_a_file_of_a_setting_is_looked_for_in_the_working_folder_first(
    written, tmp_path, monkeypatch
):
    path, shell = written(), tmp_path / "shell"
    shell.mkdir()
    (shell / "own.yaml").write_text(PROFILE, encoding="utf-8")
    monkeypatch.chdir(shell)
    found = load_experiment(path, ["device.profile=own.yaml"]).device.info.details["profile"]
    assert found == "shell/own.yaml"
    other = load_experiment(path, ["device.profile=mine/module.yaml", "name=own.yaml"])
    assert other.device.info.details["profile"] == "mine/module.yaml"
    assert other.config.name == "own.yaml"


def test_profiles_are_carried_with_the_experiment(written, tmp_path):
    reader = {"profile": "icp_m7017", "serial_port": "/dev/ttyOTHER"}
    first = load_experiment(written(input="AI0", reader=reader))
    names = {Path(path).name for path in first.files.texts}
    assert names == {"module.yaml", "icp_m7017.yaml"}
    (tmp_path / "mine" / "module.yaml").unlink()
    again = resolve(
        Document("experiment", first.yaml_text), tmp_path, files=TextFiles(first.files.texts)
    )
    assert again.device.info == first.device.info
    with pytest.raises(InputError, match="was not read"):
        resolve(Document("experiment", first.yaml_text), tmp_path, files=TextFiles({}))


def test_all_problems_come_together(written):
    text = PROFILE.replace("max_rate_hz: 1000.0", "max_rate_hz: -1.0")
    path = written(text, timeout_s=-3.0)
    with pytest.raises(ConfigError) as caught:
        load_experiment(path)
    places = {problem.key: problem.where for problem in caught.value.problems}
    assert set(places) == {"max_rate_hz", "device.timeout_s"}
    assert "mine/module.yaml" in places["max_rate_hz"]
    assert places["device.timeout_s"].startswith(f"{path}:")


@pytest.mark.parametrize(("name", "rule"), [
    ("labjack_t9", "no profile 'labjack_t9' is shipped"),
    ("mine/none.yaml", "mine/none.yaml: no such file"),
    (7, "must be text"),
])  # fmt: skip
def test_profiles_that_can_not_be_had_are_told_by_their_line(written, name, rule):
    path = written(profile=name, reader={"profile": name})
    with pytest.raises(ConfigError) as caught:
        load_experiment(path)
    assert [each.key for each in caught.value.problems] == [
        "device.profile",
        "device.reader.profile",
    ]
    lines = path.read_text(encoding="utf-8").splitlines()
    for problem in caught.value.problems:
        file, _, line = problem.where.rpartition(":")
        assert file == str(path)
        assert f"profile: {name}" in lines[int(line) - 1]
        assert rule in problem.rule
