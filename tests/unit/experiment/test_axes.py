"""Experiments with several axes: keys laid over, places in messages, joint rules."""

from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.base.axes import axis_documents, with_settings
from hilctl.base.errors import ConfigError, DeviceError
from hilctl.base.yaml import Document
from hilctl.experiment.device_rules import (
    clock_problems,
    exchange_times_s,
    link_problems,
    output_problems,
    skew_notes,
)
from hilctl.experiment.load import input_files, inputs_of, load_axes, load_experiment
from hilctl.experiment.preflight import check_axes

CONFIGS = Path(__file__).parents[3] / "configs"
STAGE = CONFIGS / "stage_xy.yaml"

TEXT = """\
name: stage
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
waveform: {kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 1.0}
compensator: none
trigger: {output: cycle}
limits: {peak_current_a: 7.0, slew_a_per_s: 1e6, stroke_um: [-75.0, 60.0]}
axes:
  x:
    device: {seed: 1}
  y:
    device: {seed: 2}
    waveform: {kind: hold, unit: A, level: 1.0, duration_s: 0.5}
"""


@pytest.fixture
def stage(tmp_path):
    """Return a function that writes an experiment with two axes."""

    def write(old="", new=""):
        assert old in TEXT
        path = tmp_path / "stage.yaml"
        path.write_text(TEXT.replace(old, new) if old else TEXT, encoding="utf-8")
        return path

    return write


def refused(path, *settings):
    """Return the problems of a refused experiment."""
    with pytest.raises(ConfigError) as error:
        check_axes(load_axes(path, settings))
    return error.value.problems


def test_mappings_are_laid_over_unless_their_kinds_differ(stage):
    x, y = load_axes(stage())
    assert [each.axis for each in (x, y)] == ["x", "y"]
    assert x.config.device == {"kind": "simulated_terfenol", "seed": 1}
    assert x.config.waveform.kind == "sine"
    assert y.config.waveform.model_dump() == {**y.config.waveform.model_dump(), "level": 1.0}
    assert "amplitude" not in y.document.data["waveform"]
    assert not {"axes", "axis"} & y.document.data.keys()


def test_the_first_axis_has_the_trigger(stage):
    x, y = load_axes(stage())
    assert (x.config.trigger is not None, y.config.trigger) == (True, None)
    assert load_experiment(stage(), ["axis=y"]).config.trigger is not None


def test_one_axis_is_an_experiment_of_its_own(stage):
    """The text that a recording contains is that of a one-axis run."""
    path = stage()
    alone = load_experiment(path, ["axis=x"])
    assert alone.axis == ""
    assert alone.yaml_text == load_axes(path)[0].yaml_text
    assert load_experiment(path, ["axis=x", "device.seed=9"]).config.device["seed"] == 9
    settings = ["axes.x.waveform.amplitude=3", "waveform.frequency_hz=7", "axis=x"]
    waveform = load_experiment(path, settings).config.waveform
    assert (waveform.amplitude, waveform.frequency_hz) == (3.0, 7.0)


def test_settings_are_those_of_all_axes_or_of_one(stage):
    x, y = load_axes(stage(), ["waveform.amplitude=2", "axes.y.device.seed=5"])
    assert x.config.waveform.amplitude == 2.0
    assert [each.config.device["seed"] for each in (x, y)] == [1, 5]
    assert y.document.where(("device", "seed")) == "setting axes.y.device.seed=5, y"


@pytest.mark.parametrize(("settings", "where", "key"), [
    (["axes.x.sample_rate_hz=5"], "setting axes.x.sample_rate_hz=5, x", "axes.x.sample_rate_hz"),
    (["axes.X.zero=true"], "setting axes.X.zero=true", "axes.X"),
    (["axes.y=none"], "setting axes.y=none", "axes.y"),
    (["axes={}"], "setting axes={}", "axes"),
    (["axes.x.device.sed=1"], "setting axes.x.device.sed=1, x", "device.sed"),
    (["axis=z"], "setting axis=z", "axis"),
    (["device.seed=3"], "setting device.seed=3", "device.seed"),  # each axis has its own
])  # fmt: skip
def test_wrong_settings(stage, settings, where, key):
    (problem,) = refused(stage(), *settings)
    assert (problem.where, problem.key) == (where, key)


def test_a_problem_of_one_axis_names_it_and_the_line(stage):
    path = stage("amplitude: 1.0", "amplitude: 9.0")
    assert {each.where for each in refused(path)} == {f"{path}:7, x"}
    path = stage("device: {seed: 2}", "device: {seed: two}")
    assert {(each.where, each.key) for each in refused(path)} == {(f"{path}:12, y", "device.seed")}


@pytest.mark.parametrize(("apart", "key"), [
    ("{axes: [x, z], um: 5.0}", "apart.axes"),
    ("{axes: [x, x], um: 5.0}", "apart.axes"),
    ("{axes: [x], um: 5.0}", "apart.axes.1"),
    ("{axes: [x, y], um: 0.0}", "apart.um"),
    ("{axes: [x, y], um: 5.0, for_s: -1.0}", "apart.for_s"),
    ("{axes: [x, y]}", "apart.um"),
])  # fmt: skip
def test_wrong_limits_of_a_difference(stage, apart, key):
    path = stage("trigger: {output: cycle}", f"apart: {apart}")
    (problem,) = refused(path)
    assert problem.key == key
    assert problem.where == f"{path}:6"


def test_a_difference_needs_axes(stage):
    apart = "apart={axes: [x, y], um: 5.0}"
    assert [each.key for each in refused(CONFIGS / "terfenol_sine_6a.yaml", apart)] == ["apart"]
    path = stage("trigger: {output: cycle}", "apart: {axes: [x, y], um: 5.0}")
    assert load_experiment(path, ["axis=x"]).config.apart is None
    assert {each.config.apart.um for each in load_axes(path)} == {5.0}


def test_unequal_safe_ramps_are_noted(stage):
    path = stage("trigger: {output: cycle}", "apart: {axes: [x, y], um: 5.0}")
    notes = len(check_axes(load_axes(path)).notes)
    slower = ["axes.y.safe={ramp_s: 3.0}"]
    assert len(check_axes(load_axes(path, slower)).notes) == notes + 1


def test_a_problem_of_all_axes_is_listed_once(stage):
    path = stage("1e6", "-1")
    assert [each.where for each in refused(path)] == [f"{path}:7"]


def test_commands_on_one_axis_ask_for_it(stage):
    with pytest.raises(ConfigError, match=r"axes x and y.*--set axis=x"):
        load_experiment(stage())
    with pytest.raises(ConfigError) as error:
        with_settings(Document("x.yaml", "name: one"), ["axis=x"])
    assert [each.key for each in error.value.problems] == ["axis"]
    assert list(axis_documents(Document("x.yaml", "name: one"))) == [""]


def test_the_shorter_axis_holds_its_last_value(stage):
    run = check_axes(load_axes(stage()))
    assert [each.reference.values.size for each in run.axes] == [1000, 1000]
    assert set(run.axes[1].reference.values) == {1.0}
    assert len(run.notes) == 1
    assert not check_axes(load_axes(STAGE)).notes


def test_files_of_axes_are_inputs(stage, tmp_path):
    path = stage("    device: {seed: 1}", "    compensator: {model: x.yaml}")
    assert tmp_path / "x.yaml" in inputs_of(path)
    document = Document("x.yaml", "axes: wrong")
    assert input_files(document, path) == [path]


def test_a_file_of_a_setting_of_an_axis_is_looked_for_in_the_working_folder(
    stage, tmp_path, monkeypatch
):
    (tmp_path / "shell").mkdir()
    monkeypatch.chdir(tmp_path / "shell")
    Path("m.yaml").write_text("x")
    assert tmp_path / "shell/m.yaml" in [
        each.resolve() for each in inputs_of(stage(), ["axes.x.compensator.model=m.yaml"])
    ]


@pytest.fixture
def real():
    """Return the properties of a real device with two outputs, as two axes use it."""
    info = load_experiment(CONFIGS / "modbus_labjack_t7.yaml").device.info
    assert not info.simulated
    info = replace(info, watchdog_timeout_s=None, arm_s=0.0)
    return {"x": replace(info, output="DAC0"), "y": replace(info, output="DAC1")}


def test_two_axes_never_drive_one_output(real):
    assert not [*output_problems(real)]
    ((axis, problem),) = output_problems(real | {"y": real["x"]})
    assert (axis, problem.key) == ("y", "device.output")
    assert "x" in problem.rule.split()
    assert real["x"].holds[0] in problem.rule
    assert not [*output_problems(real | {"y": replace(real["x"], holds=("tcp:other",))})]


def test_real_devices_of_several_axes(real):
    def keys(infos, rate_hz=1.0, block=1):
        return [(axis, each.key) for axis, each in clock_problems(infos, rate_hz, block)]

    rate_hz = real["x"].max_rate_hz
    assert keys(real) == []
    assert keys(real, rate_hz / 2.1) == []
    assert keys(real, rate_hz / 1.9) == [("x", "sample_rate_hz")]
    fifo = {name: replace(each, buffered=True, holds=(name,)) for name, each in real.items()}
    assert keys(fifo, block=2) == [("x", "block")]
    assert keys(fifo) == []
    stream = {name: replace(each, latency_blocks=2) for name, each in fifo.items()}
    assert keys(stream, block=2) == [("x", "device")]
    late = {"y": replace(real["y"], latency_blocks=2)}
    assert keys(real | late) == [("y", "device")]
    watched = {"y": replace(real["y"], watchdog_timeout_s=3.5, arm_s=0.2)}
    assert keys(real | watched) == []
    slow = {"x": replace(real["x"], arm_s=0.4)}
    assert keys(real | watched | slow) == [("y", "device.watchdog.timeout_s")]


@pytest.mark.parametrize(("rates_hz", "limit", "took"), [
    ((952.0, 952.0), "476", "1.05 ms each"),
    ((400.0, 97.0), "78.06", "2.5 and 10.3 ms"),
])  # fmt: skip
def test_the_highest_rate_of_axes_in_turn_is_stated_and_works(real, rates_hz, limit, took):
    axes = zip(real.items(), rates_hz, strict=True)
    infos = {name: replace(info, max_rate_hz=rate_hz) for (name, info), rate_hz in axes}
    ((_, problem),) = clock_problems(infos, 1000.0, 1)
    assert problem.rule == f"must be <= {limit}"
    assert took in problem.hint
    assert not [*clock_problems(infos, float(limit), 1)]


def test_axes_on_one_link_are_refused(real):
    ((axis, problem),) = link_problems(real)
    assert (axis, problem.key) == ("y", "device")
    assert not [*link_problems(real | {"y": replace(real["y"], holds=("tcp:other",))})]


class Together:
    """A joint device, for the rules."""

    axes = ("x", "y")
    max_rate_hz = 900.0
    rate_note = "a note"

    def check_rate(self, rate_hz, block):
        if block < 5 and rate_hz > 800.0:
            raise DeviceError("too fast")


def test_joined_axes_share_a_link_a_clock_and_the_time_of_an_exchange(real):
    def keys(rate_hz, block=1, more=()):
        infos = {**fifo, **dict(more)}
        return [each.key for _, each in clock_problems(infos, rate_hz, block, [Together()])]

    assert not [*link_problems(real, [Together()])]
    fifo = {name: replace(each, buffered=True) for name, each in real.items()}
    assert keys(800.0, 50) == []
    assert keys(850.0, 2) == ["block"]
    assert keys(950.0, 50) == ["sample_rate_hz"]
    other = {"z": replace(fifo["x"], holds=("tcp:other",), max_rate_hz=100.0)}
    assert keys(95.0, more=other) == ["sample_rate_hz"]
    assert keys(85.0, more=other) == []
    assert keys(10.0, 2, other) == ["block"]
    of_axes = exchange_times_s({**fifo, **other}, [Together()])
    assert of_axes == {("x", "y"): pytest.approx(1.0 / 900.0), ("z",): 0.01}


def test_joined_axes_have_one_watchdog(real):
    watched = {name: replace(each, watchdog_timeout_s=2.0) for name, each in real.items()}
    assert not [*link_problems(watched, [Together()])]
    for own, key in ((None, "device.watchdog"), (3.0, "device.watchdog.timeout_s")):
        infos = watched | {"y": replace(real["y"], watchdog_timeout_s=own)}
        ((axis, problem),) = link_problems(infos, [Together()])
        assert (axis, problem.key) == ("y", key)


def test_axes_that_are_exchanged_later_are_noted_if_they_leave_the_path():
    turn_s = {("x", "y"): 1e-3, ("z",): 2e-3, ("w",): 1e-3}
    speeds = {"x": 9e9, "y": 9e9, "z": 1000.0, "w": 1000.0}
    notes = [*skew_notes(turn_s, speeds, 1.5)]
    assert [each.split()[0] for each in notes] == ["w"]
    assert "3 ms after x" in notes[0]
    assert "3 um" in notes[0]
    assert not [*skew_notes({}, speeds, 0.0)]


def test_simulated_axes_take_no_time():
    infos = {each.axis: each.device.info for each in load_axes(STAGE)}
    assert not [*clock_problems(infos, 200000.0, 50)]


def test_two_outputs_of_one_device_are_axes_of_one_run(tmp_path):
    path = CONFIGS / "modbus_labjack_t7.yaml"
    (tmp_path / "models").symlink_to(CONFIGS / "models")
    own, text = tmp_path / "t7.yaml", path.read_text(encoding="utf-8")
    own.write_text(text + "axes:\n  x: {}\n  y: {device: {output: DAC1}}\n", encoding="utf-8")
    checked = check_axes(load_axes(own))
    assert checked.names == ["x", "y"]
    assert not checked.notes
    assert load_experiment(own, ["axis=x"]).config == load_experiment(path).config
    apart = ["axes.y.device.tcp_port=5021"]
    (note,) = check_axes(load_axes(own, apart)).notes
    assert note.startswith("y is exchanged 1 ms after x")
    (problem,) = refused(own, *apart, "sample_rate_hz=501")
    assert problem.key == "sample_rate_hz"
    (problem,) = refused(own, "axes.y.device.output=DAC0")
    assert problem.key == "device.output"


@pytest.mark.parametrize("named", ["z", "x"])
def test_crosstalk_names_another_axis(stage, named):
    crosstalk = f"device: {{seed: 1, crosstalk: {{{named}: {{gain: 0.04}}}}}}"
    (problem,) = refused(stage("device: {seed: 1}", crosstalk))
    assert problem.key == f"device.crosstalk.{named}"
    assert problem.where.endswith("stage.yaml:10, x")
    assert "y" in problem.hint
