"""Long runs are worked out once a cycle, and nothing that matters is passed over."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from hilctl.base import types
from hilctl.base.types import F64
from hilctl.experiment import command_simulation
from hilctl.experiment import preflight as check_module
from hilctl.experiment.command_simulation import CommandSimulation, whole_cycle
from hilctl.experiment.forecast import Forecast
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import load_model
from hilctl.waveforms import build, shapes
from hilctl.waveforms.build import RepeatedPart
from tests.published import terfenol_rdpi
from tests.unit.experiment.test_forecast import DISPLACEMENT, MODEL, checked

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
MODELS = {
    "rdpi": terfenol_rdpi(),
    "staged": load_model(MODEL.parent / "terfenol_staged.yaml"),
}


class Counter:
    """Figures that count what they are given."""

    def __init__(self) -> None:
        self.samples = self.passed = 0

    def add(self, reference: F64, command: F64) -> None:
        self.samples += command.size

    def mark(self) -> None:
        pass

    def pass_over(self, samples: int, times: int) -> None:
        self.passed += samples * times


def forecast(name: str, model: HysteresisModel, monkeypatch: pytest.MonkeyPatch) -> Forecast:
    """Return what is forecast of a run that does not fit in memory."""
    monkeypatch.setattr(shapes, "LONG", 100_000)
    monkeypatch.setattr(command_simulation, "LONG", 100_000)
    monkeypatch.setattr(command_simulation, "_LEAST_CYCLE", 2000)
    return checked(DISPLACEMENT, *LONG[name], *BUDGET, model=model).forecast


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("name", LONG)
def test_it_is_that_of_the_whole(
    name: str, model: HysteresisModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Range, slew, heat, how hot the coil may be before: as if all of it had been worked out."""
    whole = asdict(checked(DISPLACEMENT, *LONG[name], *BUDGET, model=model).forecast)
    found = asdict(forecast(name, model, monkeypatch))
    plain: dict[str, Any] = {}
    for key in ("heat", "line"):
        plain |= {f"{key}.{name}": whole[key][name] for name in whole[key]}
        found |= {f"{key}.{name}": found[key][name] for name in found[key]}
    plain |= {key: value for key, value in whole.items() if key not in {"heat", "line"}}
    for key, value in plain.items():
        expected = pytest.approx(value, rel=2e-3) if isinstance(value, float) else value
        assert found[key] == expected, key


def gone_through(period: float, n: int, command_of: Any = None) -> Counter:
    """Return what came of a run without a compensator, of a reference that should repeat."""
    counted = Counter()
    reference = command_of or (lambda t: np.sin(2.0 * np.pi * t / period))

    def part(start: int, stop: int) -> F64:
        return np.asarray(reference(np.arange(start, stop, dtype=np.float64)))

    run = CommandSimulation(Compensator(None, 1000.0), part, part, n, counted)
    run.go_through((RepeatedPart(1000, n - 1000, period),))
    return counted


def test_a_cycle_that_came_out_the_same_is_the_last_to_be_worked_out() -> None:
    counted = gone_through(500.0, 5_000_000)
    assert counted.samples + counted.passed == 5_000_000
    assert counted.samples < 300_000


@pytest.mark.parametrize("drift", [1e-6, 1e-9, 1e-10])
def test_what_drifts_is_worked_out(drift: float) -> None:
    """Be it so slow that no two cycles show it: but for what comes to nothing."""
    counted = gone_through(500.0, 5_000_000, lambda t: np.sin(np.pi * t / 250.0) + drift * t)
    assert counted.samples + counted.passed == 5_000_000
    assert counted.passed * drift < 1.01e-3 * 2.0


def test_what_is_not_finite_is_worked_out() -> None:
    counted = gone_through(500.0, 1_000_000, lambda t: np.where(t > 10, np.nan, t))
    assert (counted.samples, counted.passed) == (1_000_000, 0)


@pytest.mark.parametrize(("repeats", "told"), [(True, []), (False, ["0.4 million samples"])])
def test_long_work_is_told(
    repeats: bool,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Where much of it has to be worked out, and not where it repeats."""
    for module in (types, build, shapes):
        monkeypatch.setattr(module, "CHUNK", 1000)
    monkeypatch.setattr(check_module, "_MANY", 100_000)
    monkeypatch.setattr(shapes, "LONG", 100_000)
    monkeypatch.setattr(command_simulation, "LONG", 100_000)
    waveform = "waveform.duration_s=40.0" if repeats else CHIRP
    checked(DISPLACEMENT, waveform, model=terfenol_rdpi())
    texts = [each.getMessage().partition(": ")[2] for each in caplog.records]
    assert [text.partition(" are")[0] for text in texts] == told


@pytest.mark.parametrize(
    ("period", "samples", "cycle"),
    [
        (500.0, 10**9, 66_000),
        (500.0 / 3.0, 10**9, 65_536 // 500 * 500 + 500),
        (200_000.0, 10**9, 200_000),
        (200_000.0, 799_999, 0),
        (100.0 * math.sqrt(2.0), 10**9, 0),
        (shapes.LONG + 1.0, 10**12, 0),
    ],
)
def test_whole_cycles(period: float, samples: int, cycle: int) -> None:
    """Whole samples and whole periods, to the last of those that are passed over."""
    assert whole_cycle(period, samples) == cycle
    assert whole_cycle(period + 1e-6, 10**9) == 0
