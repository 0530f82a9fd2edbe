"""What a run will ask of its device is worked out before it starts, and nothing is touched."""

import math
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilctl.experiment import forecast as command_simulation
from hilctl.experiment.forecast import LineEnds, simulate_commands
from hilctl.loop.compensator import Compensator
from hilctl.models.model_file import load_model
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.waveforms import shapes
from hilctl.waveforms.build import RepeatedPart
from tests.published import terfenol_rdpi
from tests.unit.experiment.test_preflight import CURRENT, DISPLACEMENT, checked

MODEL = Path(__file__).parents[3] / "configs" / "models" / "terfenol_rdpi.yaml"


class TestForecast:
    def test_without_a_compensator(self):
        result = checked(CURRENT, "safe.value=-0.5")
        values = 0.5 + 6.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(10_000) / 10e3)
        forecast = result.forecast
        np.testing.assert_allclose(result.reference.values, values, rtol=0.0, atol=1e-11)
        assert forecast.samples == 10_000
        assert forecast.duration_s == pytest.approx(1.0)
        assert forecast.command_unit == "A"
        assert forecast.command_min == forecast.reference_min == pytest.approx(-5.5, abs=1e-4)
        assert forecast.command_max == forecast.reference_max == pytest.approx(6.5, abs=1e-4)
        assert forecast.slew_per_s == pytest.approx(1.0 * 10e3)  # from -0.5 to 0.5 in one sample

    def test_with_a_compensator(self):
        model = terfenol_rdpi()
        result = checked(DISPLACEMENT, model=model)
        command = model.inverse(10e3).process(result.reference.values)
        assert result.forecast.command_min == command.min()
        assert result.forecast.command_max == command.max()
        steps = np.abs(np.diff(command, prepend=0.0))
        assert result.forecast.slew_per_s == steps.max() * 10e3
        assert (result.forecast.reference_min, result.forecast.reference_max) == (
            result.reference.values.min(),
            result.reference.values.max(),
        )

    @pytest.mark.parametrize("chunk", [1, 7, 1000, 9999, 10_000, 10_001])
    def test_chunks_change_nothing(self, monkeypatch, chunk):
        model = terfenol_rdpi()
        whole = checked(DISPLACEMENT, AMPLIFIER, model=model).forecast
        monkeypatch.setattr("hilctl.experiment.forecast.CHUNK", chunk)
        assert checked(DISPLACEMENT, AMPLIFIER, model=model).forecast == whole

    def test_what_is_fed_ahead_is_what_is_forecast(self):
        model = StagedModel.around(terfenol_rdpi(), lag=FieldLag(tau_s=2e-4), delay_s=3e-4)
        result = checked(DISPLACEMENT, model=model)
        values = result.reference.values
        assert result.records_input
        # Its period of 1000 samples continues.
        assert result.begun.input_um.tolist() == [*values[4:], *values[-1000:-996]]
        inverse = model.inverse(10e3)
        inverse.process(values[:4].copy())
        command = inverse.process(result.begun.input_um.copy())
        assert result.forecast.command_max == command.max()
        plain = checked(DISPLACEMENT, model=terfenol_rdpi())
        assert not plain.records_input
        assert plain.begun.state is None
        assert plain.begun.input_um is plain.reference.values


AMPLIFIER = "amplifier={voltage_max_v: 90, resistance_ohm: 4, inductance_h: 5e-3, \
bandwidth_hz: 300}"
BUDGET = ("limits.rms_current_a=4.0", "limits.thermal_time_constant_s=7.0")
SEQUENCE = "waveform={kind: sequence, unit: A, repeat: 40, parts: [{kind: sine, \
amplitude: 9.0, frequency_hz: 7.0, duration_s: 1.0, soft_start_s: 0.2, soft_end_s: 0.2}, \
{kind: chirp, amplitude: 5.0, start_hz: 2.0, stop_hz: 60.0, duration_s: 0.5}]}"
CHIRP = "waveform={kind: chirp, unit: A, amplitude: 5.0, start_hz: 2.0, stop_hz: 60.0, \
duration_s: 40.0}"
LONG = {
    "sine": ("waveform.duration_s=40.0", "waveform.soft_end_s=0.3"),
    "no whole period": ("waveform.duration_s=40.0", "waveform.frequency_hz=30.0"),
    "no cycle at all": ("waveform.duration_s=40.0", f"waveform.frequency_hz={10 * math.pi}"),
    "sequence": (SEQUENCE,),
}
MODELS = {"rdpi": terfenol_rdpi(), "staged": load_model(MODEL.parent / "terfenol_staged.yaml")}


class Counter:
    """Figures that count what they are given."""

    heat = SimpleNamespace(heat_a2=0.0)

    def __init__(self):
        self.samples = self.passed = 0

    def add(self, command):
        self.samples += command.size

    def skip(self, before_a2, samples, times):
        self.passed += samples * times


def forecast(name, model, monkeypatch):
    """Return what is forecast of a run that does not fit in memory."""
    monkeypatch.setattr(shapes, "LONG", 100_000)
    monkeypatch.setattr(command_simulation, "LONG", 100_000)
    monkeypatch.setattr(command_simulation, "_LEAST_CYCLE", 2000)
    return checked(DISPLACEMENT, *LONG[name], *BUDGET, AMPLIFIER, model=model).forecast


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("name", LONG)
def test_it_is_that_of_the_whole(name, model, monkeypatch):
    whole = asdict(checked(DISPLACEMENT, *LONG[name], *BUDGET, AMPLIFIER, model=model).forecast)
    found = asdict(forecast(name, model, monkeypatch))
    plain: dict[str, Any] = {}
    for key in ("heat", "line"):
        plain |= {f"{key}.{name}": whole[key][name] for name in whole[key]}
        found |= {f"{key}.{name}": found[key][name] for name in found[key]}
    plain |= {key: value for key, value in whole.items() if key not in {"heat", "line"}}
    for key, value in plain.items():
        expected = pytest.approx(value, rel=2e-3) if isinstance(value, float) else value
        assert found[key] == expected, key


def gone_through(period, n, command_of=None):
    """Return what came of a run without a compensator, of a reference that should repeat."""
    counted = Counter()
    reference = command_of or (lambda t: np.sin(2.0 * np.pi * t / period))

    def part(start, stop):
        return np.asarray(reference(np.arange(start, stop, dtype=np.float64)))

    repeats = (RepeatedPart(1000, n - 1000, period),)
    simulate_commands(Compensator(None, 1000.0), part, part, n, counted, LineEnds(), repeats)
    return counted


def test_a_cycle_that_came_out_the_same_is_the_last_to_be_worked_out():
    counted = gone_through(500.0, 5_000_000)
    assert counted.samples + counted.passed == 5_000_000
    assert counted.samples < 300_000


@pytest.mark.parametrize("drift", [1e-6, 1e-9, 1e-10])
def test_what_drifts_is_worked_out(drift):
    counted = gone_through(500.0, 5_000_000, lambda t: np.sin(np.pi * t / 250.0) + drift * t)
    assert counted.samples + counted.passed == 5_000_000
    assert counted.passed * drift < 1.01e-3 * 2.0


REFERENCE = 10.0 + 5.0 * np.sin(np.arange(1000) / 50.0)


@pytest.mark.parametrize("slope", [0.2, -0.2])
@pytest.mark.parametrize("cut", [1, 77, 1000])
def test_line_leads_from_the_lowest_to_the_highest_command(slope, cut):
    command = 3.0 + slope * (10.0 + 5.0 * np.sin(np.arange(1000) / 50.0 + 0.3))
    ends = LineEnds()
    for start in range(0, 1000, cut):
        ends.add(REFERENCE[start : start + cut], command[start : start + cut])
    line = ends.line()
    reached = line.slope * REFERENCE + line.at_zero
    assert (reached.min(), reached.max()) == pytest.approx((command.min(), command.max()))
    assert line.slope == pytest.approx(slope, rel=1e-3)


def test_what_stands_still_or_is_no_number_has_no_line():
    for reference, command in (
        (np.full(10, 3.0), np.ones(10)),
        (REFERENCE, np.full(1000, np.inf)),
        (REFERENCE, np.where(REFERENCE > 14.0, np.nan, REFERENCE)),
    ):
        ends = LineEnds()
        ends.add(reference, command)
        assert ends.line() is None
