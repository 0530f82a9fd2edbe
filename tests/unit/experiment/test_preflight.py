"""Preflight: what is computed and rejected before anything moves."""

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from pydantic import ConfigDict

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment import preflight as module
from hilctl.experiment.load import load_experiment, resolve
from hilctl.experiment.model_validity import UNKNOWN
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.compensator import CompensatorConfig
from hilctl.experiment.sections.correction import Correction, LearnedCycle, signature
from hilctl.models.base import HysteresisModel, IdentifiedRange, Operator, Provenance
from hilctl.models.model_file import model_sha256
from hilctl.models.plays import RdpiModel
from tests.fakes import DESCRIBED, DescribedDevice
from tests.published import piezo_ppi, terfenol_rdpi

CONFIGS = Path(__file__).parents[3] / "configs"
CURRENT = """\
name: current
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: {kind: sine, unit: A, amplitude: 6.0, offset: 0.5, frequency_hz: 10.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
"""
DISPLACEMENT = """\
name: displacement
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform:
  kind: sine
  unit: um
  amplitude: 10.0
  frequency_hz: 10.0
  duration_s: 1.0
  soft_start_s: 0.1
compensator: {model: model.yaml}
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
"""


class BrokenModel(HysteresisModel):
    """A model whose inverse gives 0 A, and something that is not finite at one sample."""

    model_config = ConfigDict(allow_inf_nan=True)
    kind: str = "broken"
    bad: float
    at: int

    @property
    def operators(self):
        """Return 1: the memory counts samples."""
        return 1

    def forward(self, sample_rate_hz):
        """Return an operator that is always at rest."""
        return Operator(lambda x, memory, out: out.fill(0.0), (), self.operators)

    def inverse(self, sample_rate_hz):
        def run(x, memory, out):
            out[:] = 0.0
            first = int(memory[0])
            if first <= self.at < first + x.size:
                out[self.at - first] = self.bad
            memory[0] += x.size

        return Operator(run, (), self.operators)


def loaded(text, *settings, model=None, **info):
    """Read an experiment and put a fake device and a model in."""
    unit = info.get("command_unit", "A")
    without_model = text.replace("{model: model.yaml}", "none").replace("um\n", f"{unit}\n")
    made = resolve(Document("x.yaml", text if model is None else without_model), Path(), settings)
    device = DescribedDevice(replace(DESCRIBED, **info))
    if model is None:
        return replace(made, device=device)
    waveform = made.config.waveform.model_copy(update={"unit": "um"})
    config = made.config.model_copy(update={"waveform": waveform})
    return replace(made, config=config, device=device, model=model)


def checked(text, *settings, **given):
    return check(loaded(text, *settings, **given))


def refusals(text, *settings, **given):
    """Return the problems; each names the line of its key."""
    with pytest.raises(ConfigError) as caught:
        checked(text, *settings, **given)
    lines = text.splitlines()
    for problem in caught.value.problems:
        name, _, line = problem.where.partition(":")
        key = problem.key.rpartition(".")[2]
        assert name.startswith("setting ") or key in lines[int(line) - 1], problem
    return caught.value.problems


def told(found):
    return [(problem.key, problem.value) for problem in found]


def refused(made):
    with pytest.raises(ConfigError) as caught:
        check(made)
    return list(caught.value.problems)


def compensated(made, **keys):
    compensator = CompensatorConfig(model="model.yaml", **keys)
    config = made.config.model_copy(update={"compensator": compensator})
    return replace(made, config=config)


class TestReference:
    @pytest.mark.parametrize(("stroke", "known", "rule", "hint"), [
        ("[-9.5, 60.0]", None, "-9.5 to 60 µm", "0.5 µm"),
        ("[-75.0, 60.0]", (-12.0, 9.75), "-12 to 9.75 µm", "0.25 µm"),
    ])  # fmt: skip
    def test_outside_the_stroke_or_the_model(self, stroke, known, rule, hint):
        """The amount is part of the problem; a reference that just fits passes."""
        settings = ["waveform.soft_start_s=0.0", f"limits.stroke_um={stroke}"]
        model = terfenol_rdpi().model_copy(update={"output_range_um": known})
        (found,) = refusals(DISPLACEMENT, *settings, model=model)
        assert (found.key, found.value) == ("waveform", "-10 to 10 µm")
        assert rule in found.rule
        assert found.hint.startswith(hint)
        checked(DISPLACEMENT, *settings, "waveform.amplitude=9.5", model=model)

    def test_a_run_may_begin_at_rest_outside_the_range_of_a_model(self):
        model = terfenol_rdpi().model_copy(update={"output_range_um": (2.0, 12.0)})
        rising = ("waveform.amplitude=2.0", "waveform.offset=5.0", "waveform.soft_start_s=0.1")
        checked(DISPLACEMENT, *rising, model=model)

    def test_a_current_is_no_displacement(self):
        checked(CURRENT, "limits.stroke_um=[-1.0, 1.0]")


class TestCommand:
    @pytest.mark.parametrize(("setting", "problem"), [
        ("limits.peak_current_a=6.25", ("limits.peak_current_a", "-5.5 to 6.5 A")),
        ("waveform.offset=-2.0", ("limits.peak_current_a", "-8 to 4 A")),
        ("limits.slew_a_per_s=4000.0", ("limits.slew_a_per_s", "5000")),  # the first step
    ])  # fmt: skip
    def test_lowest_command_and_first_step(self, setting, problem):
        assert told(refusals(CURRENT, setting)) == [problem]

    def test_model_that_can_not_be_inverted(self):
        model = RdpiModel(direct=1e-310, weights=(1.0, 1.0), thresholds=(0.3, 0.6))
        found = refusals(DISPLACEMENT, "block=5", model=model)
        assert [problem.key for problem in found] == ["block", "compensator.model"]

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize("at", [0, 1, 1500])
    def test_not_a_number(self, monkeypatch, bad, at):
        monkeypatch.setattr("hilctl.experiment.forecast.CHUNK", 1000)
        found = refusals(DISPLACEMENT, model=BrokenModel(bad=bad, at=at))
        assert [problem.key for problem in found] == ["compensator.model"]


VOLTAGE = "amplifier={voltage_max_v: 8.0, resistance_ohm: 1.0, inductance_h: 0.02}"


@pytest.mark.parametrize(("bandwidth", "gain"), [("", 1.0), (", bandwidth_hz: 10.0", 0.5**0.5)])
def test_voltage_is_that_of_resistance_and_inductance(bandwidth, gain):
    """A current loop with its corner at the frequency of a sine leaves 0.71 of the amplitude."""
    setting = VOLTAGE.replace("8.0", "15.0").replace("}", bandwidth + "}")
    forecast = checked(CURRENT, setting, "waveform.soft_start_s=0.3").forecast
    expected_v = 0.5 + gain * 6.0 * abs(1.0 + 0.02j * 2.0 * np.pi * 10.0)
    assert forecast.voltage_v == pytest.approx(expected_v, rel=2e-3)
    assert checked(CURRENT).forecast.voltage_v is None


def test_an_amplifier_is_for_a_device_driven_in_current():
    with pytest.raises(ConfigError) as caught:
        load_experiment(CONFIGS / "piezo_sine.yaml", [VOLTAGE])
    assert [problem.key for problem in caught.value.problems] == ["amplifier"]


class TestDevice:
    FIFO: ClassVar = {"buffered": True, "fifo_depth": 64}
    KEPT: ClassVar = {**FIFO, "latency_blocks": 7}
    WIDE: ClassVar = "limits.stroke_um=[-100.0, 100.0]"

    @pytest.mark.parametrize(("given", "problem", "rule", "allowed"), [
        (({"command_max": 6.9},), ("limits.peak_current_a", "-7 to 7"), "",
         ({"command_max": 7.0},)),
        (({"command_min": -6.9},), ("limits.peak_current_a", "-7 to 7"), "",
         ({"command_min": -7.0},)),
        (({"command_unit": "V"},), ("limits", "A"), "in V", ({},)),
        (({"max_rate_hz": 9999.0},), ("sample_rate_hz", "10000.0"), "<= 9999",
         ({"max_rate_hz": 10_000.0},)),
        (({}, "block=2"), ("block", "2"), "", (FIFO, "block=2")),
        ((FIFO, "block=33"), ("block", "33"), "<= 32", (FIFO, "block=32")),
        ((KEPT, "block=9"), ("block", "9"), "<= 8", (KEPT, "block=8")),
        (({}, "limits.stroke_um=[-100.5, 60.0]"), ("limits.stroke_um", "-100.5 to 60"),
         "-100 to 100 µm", ({}, WIDE)),
        (({}, "limits.stroke_um=[-75.0, 100.5]"), ("limits.stroke_um", "-75 to 100.5"),
         "-100 to 100 µm", ({}, WIDE)),
    ])  # fmt: skip
    def test_beyond_the_device(self, given, problem, rule, allowed):
        info, *settings = given
        (found,) = refusals(CURRENT, *settings, **info)
        assert (found.key, found.value) == problem
        assert rule in found.rule
        info, *settings = allowed
        checked(CURRENT, *settings, **info)

    def test_model_of_another_device(self):
        found = refusals(DISPLACEMENT, "limits.peak_current_a=8.0", model=piezo_ppi())
        assert ("compensator.model", "V") in told(found)


class TestAllAtOnce:
    def test_device_reference_and_command(self):
        found = refusals(
            DISPLACEMENT,
            "block=5",
            "waveform.amplitude=100.0",
            "limits.slew_a_per_s=1.0",
            model=terfenol_rdpi(),
            max_rate_hz=100.0,
        )
        keys = [problem.key for problem in found]
        assert keys == [
            "sample_rate_hz",
            "block",
            "waveform",
            "limits.peak_current_a",
            "limits.slew_a_per_s",
        ]

    def test_device_and_a_waveform_that_can_not_be_built(self):
        found = refusals(CURRENT, "block=5", "waveform.frequency_hz=6000.0")
        assert [problem.key for problem in found] == ["block", "waveform"]


class TestWatchdog:
    @pytest.mark.parametrize(("command", "reason", "safe", "value"), [
        (0.0, "", 0.0, ""),
        (1e-10, "", 0.0, ""),
        (1.5, "", 1.5, ""),
        (1.5, "holds a load", 0.0, ""),
        (7.0, "at the limit", 0.0, ""),
        (-7.0, "at the limit", 0.0, ""),
        (1.5, "", 0.0, "1.5"),
        (1e-6, "", 0.0, "1e-06"),
        (7.5, "holds a load", 0.0, "7.5"),
    ])  # fmt: skip
    def test_safe_value_or_a_reason(self, command, reason, safe, value):
        """A value outside the limits is rejected with any reason."""
        watched = {"watchdog_command": command, "watchdog_reason": reason}
        made = loaded(CURRENT, f"safe={{value: {safe}}}", **watched)
        if not value:
            assert check(made).loaded.device.info.watchdog_command == command
        else:
            assert told(refused(made)) == [("device.watchdog.safe_command", value)]

    @pytest.mark.parametrize(
        ("timeout_s", "arm_s", "rejected"),
        [(0.1, 0.0, False), (0.1, 0.0999, True), (0.00031, 0.0, False), (0.00029, 0.0, True)],
    )
    def test_a_time_that_the_start_cannot_keep_is_refused(self, timeout_s, arm_s, rejected):
        """Three ticks of 0.1 ms, and what arming takes on the line."""
        watched = {"watchdog_command": 0.0, "watchdog_timeout_s": timeout_s, "arm_s": arm_s}
        made = loaded(CURRENT, **watched)
        if not rejected:
            check(made)
        else:
            assert [each.key for each in refused(made)] == ["device.watchdog.timeout_s"]


def within(frequency_hz):
    """Return a model that was identified at that frequency alone."""
    known = IdentifiedRange(
        peak_to_peak_um=(20.0, 20.0),
        frequency_hz=(frequency_hz, frequency_hz),
        speed_um_per_s=70.0 * frequency_hz,
    )
    return terfenol_rdpi().model_copy(update={"provenance": Provenance(identified_range=known)})


def test_a_reference_beyond_what_the_model_was_identified_on_is_warned_or_refused():
    assert check(loaded(DISPLACEMENT, model=within(10.0))).warnings == ()
    assert "repeats at 10 Hz" in check(loaded(DISPLACEMENT, model=within(30.0))).warnings[0]
    (problem,) = refused(loaded(DISPLACEMENT, "waveform.frequency_hz=60", model=within(10.0)))
    assert (problem.key, "60 Hz" in problem.rule) == ("waveform", True)
    assert check(loaded(DISPLACEMENT, model=terfenol_rdpi())).warnings == (UNKNOWN,)


PIEZO = """\
name: piezo
device: {kind: simulated_piezo}
sample_rate_hz: 1000
waveform:
  kind: sine
  unit: um
  amplitude: 12.0
  offset: 17.0
  frequency_hz: 1.0
  duration_s: 3.0
  soft_start_s: 1.0
compensator: {model: model.yaml}
limits: {drive_v: [0.0, 100.0], slew_v_per_s: 2000.0, stroke_um: [-1.0, 38.0]}
"""
VOLTS = {"command_unit": "V", "command_min": 0.0, "command_max": 100.0, "command_step": 1.5e-3}
STAGE = piezo_ppi().model_copy(update={"output_offset_um": 0.006})


def test_a_unipolar_drive_begins_at_rest_and_never_below():
    found = checked(PIEZO, model=STAGE, **VOLTS)
    assert found.forecast.command_min == 0.0
    assert not any("limits" in each for each in found.warnings)


HOLDS = """waveform={kind: sequence, unit: V, parts: [
  {kind: hold, level: 10.0, duration_s: 2.0, soft_start_s: 0.5, soft_end_s: 0.5},
  {kind: hold, level: 10.0, duration_s: 1.0, soft_start_s: 0.5}]}"""


@pytest.mark.parametrize(
    ("setting", "at_s", "part", "keys"),
    [
        ("waveform.soft_end_s=1.0", 3.0, "soft end", ["waveform.soft_end_s"]),
        (HOLDS, 2.0, "soft end", ["waveform.parts.0.soft_end_s", "waveform.parts.1.soft_start_s"]),
        ("waveform.offset=13.0", 1.75, "in waveform", ["waveform.amplitude"]),
        ("waveform.offset=36.0", 1.25, "in waveform", ["waveform.amplitude"]),
    ],
)
def test_an_exceeded_limit_is_named_with_time_part_and_a_cure(setting, at_s, part, keys):
    """A stage that was driven is above its rest position at 0 V."""
    given = (setting, "limits.stroke_um=[-9, 60]")
    wide = {**VOLTS, "sensor_max_um": 60.0}
    (found,) = refusals(PIEZO, *given, model=STAGE, **wide)
    assert found.key == "limits.drive_v"
    assert float(re.search(r"at ([.\d]+) s", found.hint).group(1)) == pytest.approx(at_s, abs=0.01)
    assert part in found.hint
    assert re.findall(r"waveform\.[\w.]+_s\b|waveform\.amplitude", found.hint) == keys
    value = re.search(r" to ([.\d]*\d)", found.hint).group(1)
    assert checked(PIEZO, *given, *(f"{key}={value}" for key in keys), model=STAGE, **wide)


def test_an_excess_below_a_step_of_the_output_is_clamped_and_said():
    given = ("waveform.rest=0.0058",)
    found = checked(PIEZO, *given, model=STAGE, **VOLTS)
    assert -1.5e-3 < found.forecast.command_min < 0.0
    assert any("limits.drive_v" in each for each in found.warnings)
    (problem,) = refusals(PIEZO, *given, model=STAGE, **VOLTS | {"command_step": 0.0})
    assert problem.key == "limits.drive_v"


def learned(made, waveform):
    """Return a correction for one segment of an experiment that was checked without."""
    wanted = signature(made.reference.values, waveform)
    coefficients = np.array([0.0, 0.2 - 0.1j, 0.0, 0.05j])
    cycle = LearnedCycle.from_coefficients(waveform.label, waveform.period, wanted, coefficients)
    return Correction(
        sample_rate_hz=made.reference.sample_rate_hz,
        model_sha256=model_sha256(made.loaded.model),
        cycles=(cycle,),
    )


def test_what_was_learned_is_added_to_the_compensator_s_input():
    plain = checked(DISPLACEMENT, model=terfenol_rdpi())
    assert not plain.records_input
    assert plain.begun.input_um is plain.reference.values
    correction = learned(plain, plain.reference.segments[0])
    found = check(replace(plain.loaded, correction=correction))
    assert found.records_input
    np.testing.assert_array_equal(found.reference.values, plain.reference.values)
    added = found.begun.input_um - plain.reference.values
    with_it = correction.added(plain.reference, plain.loaded.model)
    np.testing.assert_array_equal(found.begun.input_um, with_it)
    assert 0.1 < np.abs(added).max() < 1.0


def test_a_correction_over_several_cycles_is_computed_completely():
    """Of a long reference only the first and last cycles are computed, as if it repeated."""
    plain = checked(DISPLACEMENT, "waveform.duration_s=60.0", model=terfenol_rdpi())
    assert plain.reference.repeats
    waveform = plain.reference.segments[0]
    wanted = signature(plain.reference.values, waveform)
    bump = 0.5 * np.exp(-1j * np.pi * np.arange(4))  # highest in the middle of a period
    cycle = LearnedCycle.from_coefficients("sine", 600 * waveform.period, wanted, bump, 600)
    correction = learned(plain, waveform).model_copy(update={"cycles": (cycle,)})
    found = check(replace(plain.loaded, correction=correction))
    assert not found.reference.repeats
    assert found.forecast.command_max > 1.05 * plain.forecast.command_max


def test_what_was_learned_on_another_motion_is_refused():
    plain = checked(DISPLACEMENT, model=terfenol_rdpi())
    faster = checked(DISPLACEMENT, "waveform.frequency_hz=20", model=terfenol_rdpi())
    correction = learned(plain, plain.reference.segments[0])
    (problem,) = refused(replace(faster.loaded, correction=correction))
    assert problem.key == "compensator.correction"
    assert "hilctl learn" in problem.hint


def test_work_that_takes_long_is_told(monkeypatch, caplog):
    longer = "waveform.duration_s=300.0"
    reference = checked(DISPLACEMENT, longer, model=terfenol_rdpi()).reference
    samples = sum(part.stop - part.start for part in reference.telling)
    assert any(part.start for part in reference.telling)
    assert 1000 < samples < reference.values.size
    monkeypatch.setattr(module, "_MANY", samples)
    checked(DISPLACEMENT, longer, model=terfenol_rdpi())
    assert not caplog.records
    monkeypatch.setattr(module, "_MANY", samples - 1)
    checked(DISPLACEMENT, longer, model=terfenol_rdpi())
    (record,) = caplog.records
    assert f"{samples * 1e-6:.3g} million samples" in record.getMessage()
