"""``hilctl safe``: output confirmed, not confirmed, or refused."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import yaml

from hilctl.base.errors import ConfigError, DeviceError, InputError, UnconfirmedError
from hilctl.run.safety.manual_safe import put_safe
from hilctl_drivers.simulated.devices import SimulatedTerfenol
from tests.fakes import held_devices


class Amplifier(SimulatedTerfenol):
    """A device that records its safe values, and has a port that can be locked."""

    asked: list
    error = ""
    now_s = 0.0

    @classmethod
    def clock(cls):
        return cls.now_s

    @classmethod
    def sleep(cls, wait_s):
        cls.now_s += wait_s

    @property
    def info(self):
        return replace(super().info, holds=("tcp:10.9.8.7:502",))

    def make_safe(self, command):
        self.asked.append(command)
        type(self).now_s += 0.1
        if self.error:
            raise DeviceError(self.error)


@pytest.fixture
def amplifier(monkeypatch):
    monkeypatch.setattr("hilctl.experiment.devices.device_class", lambda kind: Amplifier)
    Amplifier.asked, Amplifier.error = [], ""
    return Amplifier


@pytest.fixture
def experiment(tmp_path):
    """An experiment without its model file, which the safe value does not need."""
    path = tmp_path / "experiment.yaml"
    section = {"kind": "simulated_terfenol"}
    given = {"device": section, "safe": {"value": 0.5}, "compensator": {"model": "gone.yaml"}}
    path.write_text(yaml.safe_dump(given), encoding="utf-8")
    return path


def test_safe_value_of_the_experiment_is_set_and_confirmed(amplifier, experiment):
    assert put_safe(experiment, [])[""].to_mapping()["output_safe"] is True
    assert put_safe(experiment, ["safe.value=-1.5"])[""].value == -1.5
    assert amplifier.asked == [0.5, -1.5]


def test_unconfirmed_output_is_not_safe(amplifier, experiment):
    amplifier.error = "no answer"
    found = put_safe(experiment, [], amplifier.clock, amplifier.sleep)[""].to_mapping()
    assert (found["output_safe"], found["error"]) == (False, "no answer")
    assert (found["output_state"], found["guardian_active"]) == ("unknown", False)
    assert len(amplifier.asked) > 10  # it is tried again and again


def test_a_device_without_confirmation_is_sent_the_value(amplifier, experiment, monkeypatch):
    monkeypatch.setattr(
        Amplifier, "make_safe", Mock(side_effect=UnconfirmedError("it does not answer"))
    )
    found = put_safe(experiment, [], amplifier.clock, amplifier.sleep)[""].to_mapping()
    assert (found["output_safe"], found["output_state"]) == (False, "sent")


def test_device_in_use_by_a_run_is_not_touched(amplifier, experiment):
    with (
        held_devices(("tcp:10.9.8.7:502",)),
        pytest.raises(InputError, match="in use"),
    ):
        put_safe(experiment, [])
    assert amplifier.asked == []


def test_safe_value_is_set_even_without_a_lock(
    amplifier, experiment, monkeypatch, tmp_path, caplog
):
    (tmp_path / "runs").write_text("")
    monkeypatch.setenv("HILCTL_RUNS", str(tmp_path / "runs"))
    found = put_safe(experiment, [], amplifier.clock, amplifier.sleep)[""].to_mapping()
    assert (found["output_state"], set(amplifier.asked)) == ("set", {0.5})
    assert caplog.messages


@pytest.mark.parametrize(
    ("text", "words"), [("name: x", "device"), ("device: {}\nsafe: {value: high}", "safe.value")]
)
def test_a_file_without_what_is_needed_is_refused(tmp_path, text, words):
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        put_safe(path, [])


def test_every_axis_is_set(amplifier, experiment, tmp_path):
    path = tmp_path / "stage.yaml"
    axes = "axes: {x: {safe: {value: 0.5}}, y: {safe: {value: -0.5}}}"
    path.write_text(f"device: {{kind: simulated_terfenol}}\n{axes}", encoding="utf-8")
    found = put_safe(path, [], amplifier.clock, amplifier.sleep)
    assert {name: (each.output, each.value) for name, each in found.items()} == {
        "x": ("confirmed", 0.5),
        "y": ("confirmed", -0.5),
    }
    assert sorted(amplifier.asked) == [-0.5, 0.5]
    assert put_safe(path, ["axis=y"])[""].value == -0.5


def test_problems_of_all_axes_are_listed(tmp_path):
    path = tmp_path / "stage.yaml"
    path.write_text("axes: {x: {safe: {value: low}}, y: {safe: {value: high}}}", encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        put_safe(path, [])
    assert {each.where.rpartition(", ")[2] for each in error.value.problems} == {"x", "y"}
