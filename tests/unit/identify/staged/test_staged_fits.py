"""Lag, hysteresis, structure and delay are found again together from their own loops."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.evaluation import judge
from hilctl.models.implicit_models import PreisachModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.staged import FieldLag, StagedModel
from tests.staged import GRID, fit, truth

Loops = Callable[..., list[SteadyLoop]]


def test_all_stages_are_found_again(loops_of: Loops) -> None:
    """Lag and its growth, resonance, damping and delay come back, and the loops with them."""
    made = truth(
        lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        structure=FirstMode(natural_hz=2300.0, damping_ratio=0.15),
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
        structure=FirstMode(natural_hz=2000.0, damping_ratio=0.2),
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


@pytest.mark.slow
def test_preisach_triangle_is_nearer_between_known_stages(loops_of: Loops) -> None:
    """A triangle in place of plays and deadbands meets loops whose plays bend one by one."""
    stages: dict[str, Any] = {
        "lag": FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        "structure": FirstMode(natural_hz=2300.0, damping_ratio=0.15),
        "delay_s": 3e-5,
    }
    lines = 12
    edges = np.linspace(-7.0, 7.0, lines + 1)
    bend = 1.5 - np.tanh(edges[:-1] / 3.0)
    made = PreisachModel(
        command_span=(-7.5, 7.5),
        thresholds=tuple((0.5 * np.arange(lines)).tolist()),
        lowest=-7.0,
        cell=float(edges[1] - edges[0]),
        slopes=tuple(tuple((bend * np.exp(-0.3 * i)).tolist()) for i in range(lines)),
    )
    loops = loops_of(StagedModel.around(made, **stages), GRID)
    plays = fit(loops)
    triangle = fit(loops, hysteresis="preisach", lines=16)
    assert triangle.rms_percent < 0.5 * plays.rms_percent
    assert isinstance(triangle.model, StagedModel)
    assert triangle.model.hysteresis.kind == "preisach"
    assert triangle.standard_errors.keys() <= triangle.parameters.keys() - {"output_offset_um"}
    assert parse_model("x.yaml", dump_model(triangle.model)) == triangle.model
    inverse, rate_hz = triangle.model.inverse(75_000.0), 75_000.0
    reference_um = 8.0 * np.sin(2.0 * np.pi * 50.0 * np.arange(6000) / rate_hz)
    command = inverse.process(np.append(reference_um, np.zeros(inverse.preview))[inverse.preview :])
    back = triangle.model.forward(rate_hz).process(command)
    error = (back - reference_um)[3000 : -2 * inverse.preview]
    assert np.max(np.abs(error)) < 0.02 * 16.0
