"""Lag, hysteresis, structure and delay are found again together from their own loops."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.judge import judge
from hilctl.models.files import dump_model, parse_model
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.models.structure import Structure
from tests.staged import GRID, fit, truth

Loops = Callable[..., list[SteadyLoop]]


def test_all_stages_are_found_again(loops_of: Loops) -> None:
    """Lag and its growth, resonance, damping and delay come back, and the loops with them."""
    made = truth(
        lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        structure=Structure(natural_hz=2300.0, damping_ratio=0.15),
        delay_s=3e-5,
    )
    found = fit(loops_of(made, GRID))
    assert found.own_peak_percent < 0.3
    assert isinstance(found.model, StagedModel)
    assert found.model.lag is not None
    assert found.model.structure is not None
    assert found.model.lag.tau_s == pytest.approx(1e-4, rel=0.02)
    assert found.model.lag.growth_per_unit == pytest.approx(0.3, rel=0.05)
    assert found.model.structure.natural_hz == pytest.approx(2300.0, rel=0.05)
    lateness_s = found.model.delay_s + found.model.structure.damping_ratio / (np.pi * 2300.0)
    assert lateness_s == pytest.approx(3e-5 + 0.15 / (np.pi * 2300.0), abs=3e-6)
    assert found.standard_errors.keys() <= found.parameters.keys() - {"g_0", "gamma"}
    for name in ("tau_s", "growth_per_unit", "natural_hz", "damping_ratio", "delay_s", "a_0"):
        assert 0.0 < found.standard_errors[name] < abs(found.parameters[name])
    assert parse_model("x.yaml", dump_model(found.model)) == found.model


def test_errors_are_those_of_the_run(loops_of: Loops) -> None:
    """A staged model judged on loops of its own run, sample by sample, has next to no error."""
    made = truth(
        lag=FieldLag(tau_s=1.5e-4, growth_per_unit=0.2),
        structure=Structure(natural_hz=2000.0, damping_ratio=0.2),
        delay_s=5.3e-5,
    )
    assert judge(made, loops_of(made, GRID)).own_peak_percent < 0.05
    rigid = truth(delay_s=5.3e-5)
    assert judge(rigid, loops_of(rigid, GRID)).own_peak_percent < 0.05


def test_plain_lag_without_structure_and_delay(loops_of: Loops) -> None:
    """Stages that were not asked for are not in the model."""
    found = fit(
        loops_of(truth(lag=FieldLag(tau_s=1e-4)), GRID), lag="plain", structure=False, delay=False
    )
    assert isinstance(found.model, StagedModel)
    assert found.model.lag is not None
    assert found.model.lag.tau_s == pytest.approx(1e-4, rel=0.02)
    assert found.model.lag.growth_per_unit == 0.0
    assert found.model.structure is None
    assert found.model.delay_s == 0.0
    assert found.own_peak_percent < 0.3


def test_without_a_lag_thresholds_grow(loops_of: Loops) -> None:
    """Where there is no lag, the rate acts on the thresholds, as published."""
    found = fit(loops_of(truth(delay_s=4e-5), GRID), lag="none", structure=False)
    assert isinstance(found.model, StagedModel)
    assert found.model.lag is None
    assert found.model.delay_s == pytest.approx(4e-5, abs=2e-6)
    assert found.parameters["gamma"] < 1e-5
    assert found.own_peak_percent < 0.3


def test_at_a_low_rate_the_delay_is_that_of_the_sampled_lag(loops_of: Loops) -> None:
    """At 1 kHz a lag of 0.1 ms is a whole sample late: half of it is no delay of the actuator."""
    slow = [(a, f / 10.0) for a, f in GRID]
    made = loops_of(truth(lag=FieldLag(tau_s=1e-4)), slow, rate_hz=1000.0)
    found = fit(made, lag="plain", structure=False)
    assert isinstance(found.model, StagedModel)
    assert found.model.delay_s < 5e-5
    assert found.own_peak_percent < 1.0


def test_a_low_pass_behind_the_plant_is_a_structure(loops_of: Loops) -> None:
    """That of a sensor, of 1 kHz and first order: no resonance, and no mass to find."""
    loops = []
    for loop in loops_of(truth(lag=FieldLag(tau_s=1e-4)), GRID):
        s = 2j * np.pi * loop.frequency_hz * np.arange(loop.command.size // 2 + 1)
        slower = np.fft.rfft(loop.displacement_um) / (1.0 + s / (2.0 * np.pi * 1000.0))
        passed = np.fft.irfft(slower, loop.command.size)
        loops.append(replace(loop, displacement_um=passed))
    assert fit(loops).own_peak_percent < 1.0
