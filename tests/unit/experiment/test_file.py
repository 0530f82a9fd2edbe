"""Experiment files: accepted ones, and line and key of every broken rule."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import pytest
from pydantic import TypeAdapter, ValidationError

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import ConfigError, InputError
from hilctl.base.yaml import Document
from hilctl.experiment import devices as registry
from hilctl.experiment.file import Name
from hilctl.experiment.load import load_experiment, resolve
from hilctl.experiment.sections.limits import Interval
from hilctl.experiment.sections.timing import Timing

FULL = """\
name: full_example
description: Everything that an experiment can say.
device:
  kind: simulated_terfenol
  seed: 3
  noise: false
  load_kg: 3.7
  fault:
    kind: sensor_nan
    at_sample: 9000
sample_rate_hz: 50000
block: 50
waveform:
  kind: sine
  unit: um
  amplitude: 2.5
  offset: -1.0
  frequency_hz: 10.0
  phase_deg: 90
  duration_s: 2.0
  soft_start_s: 0.1
  soft_end_s: 0.2
compensator:
  model: model.yaml
limits:
  peak_current_a: 7.07
  slew_a_per_s: 20000.0
  stroke_um: [-75.0, 60.0]
safe:
  value: 0.5
  ramp_s: 0.2
timing:
  late_after: 0.25
  max_late_s: 2.0
  max_missed_share: 0.5
recording:
  folder: runs
  flush_s: 0.5
  sync: true
  scope_rate_hz: 500.0
  ring_s: 20.0
  on_failure: go_on
"""
LINES = {
    line.split(":")[0].strip(): number for number, line in enumerate(FULL.splitlines(), start=1)
}

MODEL = """\
model:
  kind: rdpi
  input_unit: A
  direct: 2.7
  weights: [2.3, 0.1, 0.4]
  thresholds: [0.3, 0.6, 0.9]
  gamma_s: 0.0003
  output_range_um: [-12.0, 12.0]
"""

MINIMAL = """\
name: minimal
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
waveform: {kind: hold, unit: A, level: 1.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 2.0, slew_a_per_s: 5000.0, stroke_um: [-75.0, 60.0]}
"""
VOLTAGE = """\
name: voltage
device: {kind: simulated_piezo}
sample_rate_hz: 1000
waveform: {kind: hold, unit: V, level: 1.0, duration_s: 1.0}
compensator: none
limits: {drive_v: [-1.0, 5.0], slew_v_per_s: 5000.0, stroke_um: [-75.0, 60.0]}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.yaml").write_text(MODEL)
    return tmp_path


def load(text, folder=Path(), settings=()):
    return resolve(Document("x.yaml", text), folder, settings)


def problems(text, folder=Path(), settings=()):
    """Return place and key of each problem of a file that is rejected."""
    with pytest.raises(ConfigError) as caught:
        load(text, folder, settings)
    assert str(caught.value) == "\n".join(str(problem) for problem in caught.value.problems)
    return [(problem.where, problem.key) for problem in caught.value.problems]


def changed(old, new, text=FULL):
    assert text.count(old) == 1, old
    return text.replace(old, new)


class TestAccepted:
    def test_minimal_example(self):
        loaded = load(MINIMAL)
        assert (loaded.model, loaded.config.compensator) == (None, None)
        assert (loaded.config.block, loaded.config.safe.value) == (1, 0.0)

    def test_voltage(self):
        limits = load(VOLTAGE).config.limits
        assert (limits.unit, limits.command_range, limits.slew_per_s) == ("V", (-1.0, 5.0), 5000.0)

    def test_ramp(self, folder):
        """The safe ramp takes ramp_s from the command furthest away, within the slew limit."""
        limits = load(FULL, folder).config.command_limits()
        assert (limits.low, limits.high, limits.safe) == (-7.07, 7.07, 0.5)
        assert limits.ramp_per_s == pytest.approx(7.57 / 0.2)
        slow = changed("slew_a_per_s: 20000.0", "slew_a_per_s: 10.0")
        assert load(slow, folder).config.command_limits().ramp_per_s == 10.0

    def test_text_reads_back_the_same(self, folder):
        text = changed("description: Everything that an experiment can say.", "description: '1e3'")
        loaded = load(text, folder, ("waveform.frequency_hz=12.5", "limits.stroke_um.0=-70"))
        again = load(loaded.yaml_text, folder)
        assert again.config == loaded.config
        assert again.config.waveform.model_dump()["frequency_hz"] == 12.5
        assert again.config.limits.stroke_um == (-70.0, 60.0)
        assert again.config.description == "1e3"
        assert again.yaml_text == loaded.yaml_text

    def test_file(self, folder):
        (folder / "x.yaml").write_text(FULL)
        loaded = load_experiment(folder / "x.yaml")
        assert loaded.model is not None
        assert loaded.folder == folder


ONE_RULE = [
    # key whose line is named, text to replace, replacement, key of the problem
    ("name", "name: full_example", "name: a b", "name"),
    ("sample_rate_hz", "sample_rate_hz: 50000", "sample_rate_hz: 50_000", "sample_rate_hz"),
    ("sample_rate_hz", "sample_rate_hz: 50000", "sample_rate_hz: 2.0e+6", "sample_rate_hz"),
    ("block", "block: 50", "block: 4097", "block"),
    ("unit", "unit: um", "unit: mm", "waveform.unit"),
    ("unit", "unit: um", "unit: A", "waveform.unit"),
    ("duration_s", "duration_s: 2.0", "duration_s: -2.0", "waveform.duration_s"),
    ("phase_deg", "phase_deg: 90", "phase: 90", "waveform.phase"),
    ("model", "model: model.yaml", "model: 3", "compensator.model"),
    ("compensator", "compensator:\n  model: model.yaml", "compensator: {}", "compensator.model"),
    ("compensator", "compensator:\n  model: model.yaml", "compensator:", "compensator"),
    ("limits", "  slew_a_per_s: 20000.0\n", "", "limits"),
    ("limits", "  peak_current_a: 7.07\n", "  drive_v: [-1, 1]\n", "limits"),
    ("slew_a_per_s", "slew_a_per_s: 20000.0", "slew_a_per_s: 0", "limits.slew_a_per_s"),
    ("stroke_um", "[-75.0, 60.0]", "[60.0, -75.0]", "limits.stroke_um"),
    ("stroke_um", "[-75.0, 60.0]", "[low, 60.0]", "limits.stroke_um.0"),
    ("value", "value: 0.5", "value: 7.1", "safe.value"),
    (
        "max_missed_share",
        "max_missed_share: 0.5",
        "max_missed_share: 1.1",
        "timing.max_missed_share",
    ),
    *(
        ("max_missed_share", "max_missed_share: 0.5", f"{each}: 0.5", f"timing.{each}")
        for each in Timing.REMOVED
    ),
    ("scope_rate_hz", "scope_rate_hz: 500.0", "scope_rate_hz: 1001", "recording.scope_rate_hz"),
    ("ring_s", "ring_s: 20.0", "ring_s: 1.0", "recording"),
    ("seed", "seed: 3", "sed: 3", "device.sed"),
    ("load_kg", "load_kg: 3.7", "load_kg: 101", "device.load_kg"),
    ("fault", "    at_sample: 9000\n", "", "device.fault.at_sample"),
]


@pytest.mark.parametrize(("line", "old", "new", "key"), ONE_RULE)
def test_one_broken_rule(folder, line, old, new, key):
    assert problems(changed(old, new), folder) == [(f"x.yaml:{LINES[line]}", key)]


@pytest.mark.parametrize(
    "key", ["name", "device", "sample_rate_hz", "waveform", "compensator", "limits"]
)
def test_required(key):
    """A section that is left out is named; the line is that of the file's first key."""
    text = "".join(line for line in MINIMAL.splitlines(True) if not line.startswith(f"{key}:"))
    assert problems(text) == [("x.yaml:1", key)]


@pytest.mark.parametrize("key", ["waveform", "limits", "safe", "timing", "recording", "device"])
@pytest.mark.parametrize("value", ["5", "[1]", "text"])
def test_section_that_is_no_mapping(key, value):
    lines = [line for line in MINIMAL.splitlines() if not line.startswith(f"{key}:")]
    text = "\n".join([*lines, f"{key}: {value}"])
    assert problems(text) == [(f"x.yaml:{len(lines) + 1}", key)]


class TestMany:
    def test_all_are_listed(self, folder):
        text = FULL
        for old, new in [
            ("name: full_example", "name: ''"),
            ("seed: 3", "seed: x"),
            ("load_kg: 3.7", "load: 3.7"),
            ("block: 50", "block: 0.5"),
            ("frequency_hz: 10.0", "frequency_hz: 1:30"),
            ("model: model.yaml", "model: lost.yaml"),
            ("ramp_s: 0.2", "ramp: 0.2"),
            ("flush_s: 0.5", "flush_s: .nan"),
        ]:
            text = changed(old, new, text)
        found = problems(text, folder)
        where = sorted((int(place.split(":")[1]), key) for place, key in found)
        assert where == [
            (LINES["name"], "name"),
            (LINES["seed"], "device.seed"),
            (LINES["load_kg"], "device.load"),
            (LINES["block"], "block"),
            (LINES["frequency_hz"], "waveform.frequency_hz"),
            (LINES["model"], "compensator.model"),
            (LINES["ramp_s"], "safe.ramp"),
            (LINES["flush_s"], "recording.flush_s"),
        ]

    def test_units_and_safe_value_together(self):
        text = MINIMAL.replace("unit: A", "unit: um") + "safe:\n  value: -2.5\n"
        assert problems(text) == [("x.yaml:4", "waveform.unit"), ("x.yaml:8", "safe.value")]

    def test_safe_value_not_given(self):
        text = VOLTAGE.replace("[-1.0, 5.0]", "[1.0, 5.0]")
        assert problems(text) == [("x.yaml:1", "safe.value")]


class TestSet:
    def test_over_the_file(self, folder):
        config = load(
            FULL,
            folder,
            (
                "block=10",
                "waveform.frequency_hz=20.0",
                "limits.stroke_um.1=55.5",
                "device.fault=null",
                "timing={max_missed_share: 0}",
                "name='7'",
            ),
        ).config
        assert (config.block, config.name, config.limits.stroke_um) == (10, "7", (-75.0, 55.5))
        assert config.waveform.model_dump()["frequency_hz"] == 20.0
        assert config.timing.max_missed_share == 0.0
        assert config.timing.late_after == 0.5

    @pytest.mark.parametrize(("setting", "key"), [
        ("block=2.5", "block"),
        ("limits.stroke_um.0=x", "limits.stroke_um.0"),
        ("waveform.freq_hz=3.0", "waveform.freq_hz"),
        ("device.seeds=3", "device.seeds"),
        ("safe.value=99", "safe.value"),
        ("limits.stroke_um.2=5", "limits.stroke_um.2"),
    ])  # fmt: skip
    def test_broken(self, folder, setting, key):
        assert problems(FULL, folder, (setting,)) == [(f"setting {setting}", key)]

    def test_a_broken_file_can_be_mended(self, folder):
        text = changed("frequency_hz: 10.0", "frequency_hz: 1:30")
        assert load(text, folder, ("waveform.frequency_hz=10.0",)).config.block == 50


class TestDevice:
    @pytest.mark.parametrize("section", ["{kind: simulated_terfanol}", "{seed: 1}", "{kind: 5}"])
    def test_kind_that_is_none(self, section):
        found = problems(MINIMAL.replace("{kind: simulated_terfenol}", section))
        assert found == [("x.yaml:2", "device.kind")]

    @pytest.mark.parametrize("kind", sorted(registry.BUILTIN))
    def test_options_of_every_built_in_device(self, kind):
        text = MINIMAL.replace("simulated_terfenol", f"{kind}, nosuchoption: 1")
        assert ("x.yaml:2", "device.nosuchoption") in problems(text)

    def test_device_that_refuses_its_options(self, monkeypatch):

        class Picky:
            Options: ClassVar[type[DeviceOptions]] = DeviceOptions

            def __init__(self, options):
                raise InputError("picky.yaml: no such profile")

        monkeypatch.setitem(registry.BUILTIN, "picky", "picky_driver:Picky")
        monkeypatch.setitem(sys.modules, "picky_driver", SimpleNamespace(Picky=Picky))
        text = MINIMAL.replace("simulated_terfenol", "picky").replace("name: minimal", "name: ''")
        assert problems(text)[1:] == [("x.yaml:2", "device")]


class TestModel:
    @pytest.mark.parametrize("name", ["sub/lost.yaml", "."])
    def test_missing(self, folder, name):
        found = problems(changed("model: model.yaml", f"model: {name}"), folder)
        assert found == [(f"x.yaml:{LINES['model']}", "compensator.model")]

    @pytest.mark.parametrize(("old", "new", "line", "key"), [
        ("direct: 2.7", "direct: 0.0", 1, "model"),
        ("[0.3, 0.6, 0.9]", "[0.3, 0.6]", 5, "model"),
        ("gamma_s: 0.0003", "gamma_s: -0.1", 7, "model.gamma_s"),
        ("weights: [2.3, 0.1, 0.4]", "weights: [2.3, 0.1, 0.4", 6, ""),
    ])  # fmt: skip
    def test_broken(self, folder, old, new, line, key):
        path = folder / "model.yaml"
        path.write_text(changed(old, new, MODEL))
        assert problems(FULL, folder) == [(f"{path}:{line}", key)]


NAME, INTERVAL = TypeAdapter(Name), TypeAdapter(Interval)


@pytest.mark.parametrize("text", ["a", "9.x_y-z", "a" * 80])
def test_names_that_can_be_file_names(text):
    assert NAME.validate_python(text) == text


@pytest.mark.parametrize("text", ["", ".hidden", "a b", "a/b", "../a", "a" * 81, "ä", "a\n"])
def test_other_names_are_refused(text):
    with pytest.raises(ValidationError, match="at most 80 letters"):
        NAME.validate_python(text)
