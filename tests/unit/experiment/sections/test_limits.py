"""Limits against the device, interlocks with what they need, the thermal budget in advance."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.limits import Limits, range_problems
from hilctl.loop.interlocks import Interlocks
from tests.published import terfenol_rdpi

CURRENT = """\
name: current
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
waveform: {kind: sine, unit: A, amplitude: 6.0, frequency_hz: 10.0, duration_s: 4.0}
compensator: none
safe: {value: 0.5}
limits:
  peak_current_a: 7.0
  slew_a_per_s: 20000.0
  stroke_um: [-75.0, 60.0]
"""
VOLTAGE = """\
name: voltage
device: {kind: simulated_piezo}
sample_rate_hz: 1000
waveform: {kind: hold, unit: V, level: 0.0, duration_s: 1.0}
compensator: none
limits:
  drive_v: [0.0, 10.0]
  slew_v_per_s: 100.0
  stroke_um: [-1.0, 38.0]
"""
BUDGET = ("limits.rms_current_a=4.0", "limits.thermal_time_constant_s=1.5")
STROKE = {"stroke_um": (-50.0, 50.0)}
IN_AMPERES = {"peak_current_a": 7.0, "slew_a_per_s": 1e4}
IN_VOLTS = {"drive_v": (-20.0, 120.0), "slew_v_per_s": 2e4}


def loaded(text, *settings, **info):
    made = resolve(Document("x.yaml", text), Path(), settings)
    if info:
        made.device._info = replace(made.device.info, **info)
    return made


def refusals(text, *settings, **info):
    with pytest.raises(ConfigError) as caught:
        check(loaded(text, *settings, **info))
    return caught.value.problems


@pytest.mark.parametrize("given", [{}, {"peak_current_a": 7.0}, {"slew_v_per_s": 2e4},
                                   {**IN_AMPERES, "drive_v": (0.0, 1.0)},
                                   {**IN_AMPERES, "drive_a": (0.0, 1.0)},
                                   {**IN_AMPERES, **IN_VOLTS}])  # fmt: skip
def test_incomplete_and_mixed_limits_are_refused(given):
    with pytest.raises(ValidationError, match="peak_current_a"):
        Limits(**STROKE, **given)


class TestConsistency:
    @pytest.mark.parametrize(
        "setting",
        [
            "rms_current_a=0", "thermal_time_constant_s=-1", "tracking_error_um=0",
            "tracking_s=-0.1", "frozen_s=0", "frozen_um=-1", "measured_deviation_a=.inf",
            "deviation_s=-1", "rms_curent_a=1",
        ],
    )  # fmt: skip
    def test_values_that_mean_nothing(self, setting):
        with pytest.raises(ConfigError) as caught:
            loaded(CURRENT, f"limits.{setting}")
        [problem] = caught.value.problems
        key = f"limits.{setting.split('=')[0]}"
        assert (problem.where, problem.key) == (f"setting limits.{setting}", key)

    @pytest.mark.parametrize(("text", "settings", "word"), [
        (CURRENT, ["tracking_error_um=2.0"], "compensator"),
        (CURRENT, ["rms_current_a=4.0"], "limits.thermal_time_constant_s"),
        (CURRENT, ["thermal_time_constant_s=4.0"], "limits.rms_current_a"),
        (CURRENT, ["tracking_s=0.1"], "limits.tracking_error_um"),
        (CURRENT, ["frozen_um=0.1"], "limits.frozen_s"),
        (CURRENT, ["deviation_s=0.1"], "limits.measured_deviation_a"),
        (VOLTAGE, ["deviation_s=0.1"], "limits.measured_deviation_v"),
        (CURRENT, ["measured_deviation_v=1.0"], "in V"),
        (CURRENT, ["aux.coil_c=80"], "has none"),
        (VOLTAGE, ["rms_current_a=1.0", "thermal_time_constant_s=1.0", "measured_deviation_a=1.0"],
         "in A"),
    ])  # fmt: skip
    def test_refused_by_key(self, text, settings, word):
        found = refusals(text, *(f"limits.{setting}" for setting in settings))
        keys = [f"limits.{setting.partition('=')[0]}" for setting in settings]
        assert [problem.key for problem in found] == keys
        assert all(word in problem.rule for problem in found)

    @pytest.mark.parametrize(("text", "setting", "cure"), [
        (CURRENT, "peak_current_a=[0, 9]", "set limits.drive_a to [0, 9]"),
        (CURRENT, "stroke_um=50", "[-50, 50]"),
        (CURRENT, "stroke_um=0,50", "write [0, 50]"),
        (VOLTAGE, "drive_v=(0,100)", "write [0, 100]"),
    ])  # fmt: skip
    def test_wrong_forms_are_refused_with_the_right_one(self, text, setting, cure):
        with pytest.raises(ConfigError) as caught:
            loaded(text, f"limits.{setting}")
        [problem] = caught.value.problems
        assert problem.key == f"limits.{setting.partition('=')[0]}"
        assert cure in str(problem)

    @pytest.mark.parametrize(("limits", "section", "words"), [
        ({"drive_v": (0.0, 100.0)}, {"amplifier": {"gain_v_per_v": 1.0}},
         ["device.amplifier (gain_v_per_v 1.0)", "limits.drive_v to [0.0, 10.0]"]),
        ({"drive_v": (0.0, 100.0)}, {}, ["limits.drive_v to [0.0, 10.0]"]),
        ({"stroke_um": (-1e3, 9.0)}, {"sensor": {"um_per_v": 10.0}},
         ["device.sensor (um_per_v 10.0)", "limits.stroke_um to [-50.0, 9.0]"]),
    ])  # fmt: skip
    def test_a_range_that_is_too_small_may_be_due_to_a_scale(self, limits, section, words):
        limits = Limits(**{**STROKE, **IN_VOLTS, **limits})
        info = SimpleNamespace(command_unit="V", name="x", command_min=0.0, command_max=10.0,
                               sensor_min_um=-50.0, sensor_max_um=50.0)  # fmt: skip
        found = [*range_problems(limits, info, section)][-1]
        assert all(word in found.hint for word in words)
        assert ("device." in found.hint) == bool(section)

    def test_device_that_does_not_measure(self):
        (found,) = refusals(CURRENT, "limits.measured_deviation_a=1.0", measures_command=False)
        assert found.key == "limits.measured_deviation_a"
        assert "simulated_terfenol" in found.rule
        check(loaded(CURRENT, "limits.measured_deviation_a=1.0"))

    @pytest.mark.parametrize(
        ("compensator", "settings", "error_um", "time_s"),
        [
            ("{model: models/terfenol_omega.yaml}", [], 33.75, 1e-3),
            ("{model: models/terfenol_omega.yaml}", ["sample_rate_hz=10"], 33.75, 0.1),
            ("{model: models/terfenol_omega.yaml}", ["tracking_error_um=null"], None, None),
            ("{model: models/terfenol_omega.yaml}", ["tracking_error_um=5"], 5.0, None),
            ("none", [], None, None),
        ],
    )
    def test_a_compensated_run_has_a_limit_of_its_tracking_error(
        self, compensator, settings, error_um, time_s
    ):
        text = CURRENT.replace("none", compensator)
        if compensator != "none":
            text = text.replace("unit: A", "unit: um")
        made = resolve(
            Document("x.yaml", text),
            Path(__file__).parents[4] / "configs",
            [s if "rate" in s else f"limits.{s}" for s in settings],
        )
        interlocks = made.rig.interlocks
        assert (interlocks.tracking_error_um, interlocks.tracking_s) == (error_um, time_s)


class TestHeatForecast:
    def test_without_a_budget(self):
        forecast = check(loaded(CURRENT)).forecast
        assert forecast.heating_rms_a is None
        assert forecast.to_mapping()["heating_rms_a"] is None

    def test_highest_running_rms(self):
        settings = ("limits.rms_current_a=4.3", "limits.thermal_time_constant_s=0.5")
        found = check(loaded(CURRENT, *settings)).forecast.heating_rms_a
        command = 6.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(4000) / 1e3)
        heat, highest = 0.25, 0.0
        for value in command:
            heat += (value**2 - heat) * (1.0 - math.exp(-1.0 / 500.0))
            highest = max(highest, heat)
        assert found == pytest.approx(math.sqrt(highest), rel=1e-9)

    def test_safe_value_alone(self):
        hold = ["waveform={kind: hold, unit: A, level: 0.5, duration_s: 1.0}"]
        budget = ("limits.rms_current_a=0.5", "limits.thermal_time_constant_s=1.0")
        assert check(loaded(CURRENT, *hold, *budget)).forecast.heating_rms_a == 0.5
        found = refusals(CURRENT, *hold, "limits.rms_current_a=0.4", budget[1])
        assert (found[0].key, found[0].value) == ("limits.rms_current_a", "0.5 A")
        assert found[0].hint.startswith("0.1 A")

    @pytest.mark.parametrize("chunk", [1, 700, 4000, 1_000_000])
    def test_refused_with_when_and_by_how_much(self, monkeypatch, chunk):
        monkeypatch.setattr("hilctl.experiment.forecast.CHUNK", chunk)
        (found,) = refusals(CURRENT, *BUDGET)
        assert (found.key, found.value) == ("limits.rms_current_a", "4.105 A")
        assert found.hint.startswith("0.105 A")
        assert "at 3.23 s" in found.hint

    def test_where_the_forecast_says_the_interlock_trips(self):
        """The run itself would trip at the very sample that the refusal names.

        A sine's heat is 18 (1 - e^(-t / tau)) with a ripple of 0.095 A^2, and 0.25 A^2 to begin
        with: it reaches 16 A^2 between 3.205 and 3.275 s.
        """
        made = loaded(CURRENT, *BUDGET)
        reference = 6.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(4000) / 1e3)
        interlocks = Interlocks(made.rig.interlock_context(), made.config.limits, 1e3)
        none, flags = np.full(4000, np.nan), np.zeros(4000, dtype=np.uint32)
        trip = interlocks.check(0, reference, none, np.zeros(4000), none, flags)
        assert (trip.code, trip.sample) == ("thermal", 3230)

    def test_commands_of_the_inverse_count(self):
        made = loaded(CURRENT, *BUDGET)
        waveform = made.config.waveform.model_copy(update={"unit": "um", "amplitude": 15.0})
        model = terfenol_rdpi()
        limits = made.config.limits.model_copy(update={"slew_a_per_s": 1e6})
        config = made.config.model_copy(update={"waveform": waveform, "limits": limits})
        found = check(replace(made, config=config, model=model)).forecast
        command = model.inverse(1e3).process(15.0 * np.sin(2.0 * np.pi * np.arange(4000) / 100.0))
        settled = math.sqrt(float(np.mean(command[2000:] ** 2)))
        assert 0.9 * settled < found.heating_rms_a < settled

    def test_currents_near_the_end_of_the_numbers(self):
        found = refusals(CURRENT, *BUDGET, "waveform.amplitude=1.0e+200")
        assert len(found) == 3
        assert found[-1].key == "limits.rms_current_a"
