"""Rules between an experiment and its device; the thermal budget in advance."""

import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.device import AuxChannel
from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment import device_rules
from hilctl.experiment.device_rules import (
    calibration_warnings,
    interlock_context,
    pace_warnings,
    start_warnings,
    timeout_warnings,
)
from hilctl.experiment.load import load_experiment, resolve
from hilctl.experiment.preflight import check
from hilctl.loop.interlocks import Interlocks
from tests.published import terfenol_rdpi
from tests.unit.base.test_calibration import CALIBRATION

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


def loaded(text, *settings, **info):
    made = resolve(Document("x.yaml", text), Path(), settings)
    if info:
        made.device._info = replace(made.device.info, **info)
    return made


def refusals(text, *settings, **info):
    with pytest.raises(ConfigError) as caught:
        check(loaded(text, *settings, **info))
    return caught.value.problems


class TestContext:
    def test_rig(self):
        """Stroke and safe value from the file, the sensor's ends from the device."""
        made = loaded(CURRENT)
        context = interlock_context(made.config, made.device.info)
        assert context.stroke_um == (-75.0, 60.0)
        assert context.sensor_um == (-125.0, 125.0)
        assert (context.unit, context.safe) == ("A", 0.5)
        assert context.frozen_travel == pytest.approx(0.02 * 14.0)

    def test_in_volt(self):
        made = loaded(VOLTAGE, "limits.measured_deviation_v=0.3", "limits.frozen_s=0.1")
        context = interlock_context(made.config, made.device.info)
        assert (context.unit, made.config.limits.measured_deviation) == ("V", 0.3)
        assert context.frozen_travel == pytest.approx(0.02 * 10.0)

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
        assert (problem.where, problem.key) == (f"--set limits.{setting}", key)


class TestConsistency:
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

    @pytest.mark.parametrize(("names", "refused"), [
        (["coil_c", "c" * 63], []),
        (["c" * 64], ["c" * 64]),
        (["température", "_x", "coil_c"], ["température", "_x"]),
        (["coil_c", "coil_c"], ["coil_c"]),
        (["end", "displacement", "run_id"], ["end", "displacement", "run_id"]),
    ])  # fmt: skip
    def test_names_of_auxiliary_channels(self, names, refused):
        """MATLAB accepts 63 letters, digits and '_'; no two columns or signals have one name."""
        found = device_rules._aux_problems(loaded(CURRENT, aux=tuple(map(AuxChannel, names))))
        assert [each.key for each in found] == [f"device.aux.{name}" for name in refused]

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
            Path(__file__).parents[3] / "configs",
            [s if "rate" in s else f"limits.{s}" for s in settings],
        )
        interlocks = made.config.interlocks
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
        assert "after 3.23 s" in found.hint

    def test_where_the_forecast_says_the_interlock_trips(self):
        """The run itself would trip at the very sample that the refusal names.

        A sine's heat is 18 (1 - e^(-t / tau)) with a ripple of 0.095 A^2, and 0.25 A^2 to begin
        with: it reaches 16 A^2 between 3.205 and 3.275 s.
        """
        made = loaded(CURRENT, *BUDGET)
        reference = 6.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(4000) / 1e3)
        interlocks = Interlocks(
            interlock_context(made.config, made.device.info), made.config.limits, 1e3
        )
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


DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


def warned(*settings, **info):
    loaded = load_experiment(DEMO, settings)
    return pace_warnings(loaded.config, replace(loaded.device.info, **info))


@pytest.mark.parametrize(("block", "told"), [(4, True), (5, False)])
def test_ticks_of_less_than_a_tenth_of_a_millisecond_are_told(block, told):
    """The demo has 50 kHz."""
    assert bool(warned(f"block={block}")) == told


@pytest.mark.parametrize(("timeout_s", "warnings"), [(0.5, 0), (0.51, 1), ("text", 0), (None, 0)])
def test_a_timeout_longer_than_a_tick_may_be_late_is_told(timeout_s, warnings):
    timing = SimpleNamespace(max_late_s=0.5)
    found = timeout_warnings(SimpleNamespace(device={"timeout_s": timeout_s}, timing=timing))
    assert len(found) == warnings
    assert all("timing.max_late_s, 0.5 s" in each for each in found)


@pytest.mark.parametrize(("reads", "at_start", "warnings"), [
    (True, "null", 0), (False, "0.5", 0), (False, "null", 1),
])  # fmt: skip
def test_an_output_that_cannot_be_read_is_told(reads, at_start, warnings):
    loaded = load_experiment(DEMO, [f"safe.at_start={at_start}"])
    info = replace(loaded.device.info, reads_output=reads)
    assert len(start_warnings(loaded.config, info)) == warnings


@pytest.mark.parametrize(("now", "warnings"), [("2027-01-31", 0), ("2027-02-02", 1)])
def test_a_calibration_of_more_than_a_year_ago_is_told(tmp_path, now, warnings):
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    info = loaded(CURRENT, f"device.calibration={path}").device.info
    now_s = datetime.fromisoformat(f"{now}T12:00+00:00").timestamp()
    assert len(calibration_warnings(info, now_s)) == warnings
    assert len(calibration_warnings(info, 1e12)) == 1  # as a campaign asks, after the year 9999


def test_a_poor_calibration_is_told(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION.replace("residual_max: 0.2", "residual_max: 2.1"))
    info = loaded(CURRENT, f"device.calibration={path}").device.info
    (warning,) = calibration_warnings(info, datetime(2026, 2, 1, tzinfo=UTC).timestamp())
    assert "2.1 %" in warning


@pytest.mark.parametrize(("block", "problems"), [(58, 1), (580, 0)])
def test_a_block_too_small_for_the_rate_is_refused(block, problems):
    """A T7 streams at most 29 kHz with blocks of 58."""
    stream = Path(__file__).parents[3] / "configs" / "modbus_labjack_t7_stream.yaml"
    found = load_experiment(stream, ["sample_rate_hz=50000", f"block={block}"])
    keys = [each.key for each in device_rules._pace_problems(found)]
    assert keys == ["block"] * problems


def test_the_text_says_what_to_do():
    (text,) = warned("block=1")
    assert text.startswith("sample_rate_hz: 50000")
    assert "larger block" in text
    (text,) = warned("block=1", buffered=False)
    assert "lower rate" in text


def test_a_check_tells():
    settings = ["sample_rate_hz=20000", "block=1", "waveform.duration_s=1.0"]
    checked = check(load_experiment(DEMO, settings))
    assert any("ticks per second" in each for each in checked.warnings)


@pytest.mark.parametrize(
    ("settings", "info", "keys"),
    [
        (["trigger={output: run}"], {"digital_output": ""}, ["trigger.output"]),
        (["trigger={start: low}"], {"digital_input": ""}, ["trigger.start"]),
        (["trigger={start: low}", "block=10"], {}, ["block"]),
        (
            ["trigger={output: run, start: high}", "block=10"],
            {"digital_output": "", "digital_input": ""},
            ["trigger.output", "trigger.start", "block"],
        ),
    ],
)
def test_triggers_need_channels_and_blocks_of_one_sample(settings, info, keys):
    problems = refusals(CURRENT, *settings, **info)
    assert [each.key for each in problems] == keys
    assert all(each.hint or "must be 1" in each.rule for each in problems)
