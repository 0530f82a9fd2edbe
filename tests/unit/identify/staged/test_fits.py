"""Lag, hysteresis, structure and delay are found again together from their own loops."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.judge import judge
from hilctl.identify.settings import FitSettings
from hilctl.identify.staged.convex import convex_start
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.layered import Layers, Point, bounds, error_and_slopes
from hilctl.models.files import dump_model, parse_model
from hilctl.models.preisach import PreisachModel
from hilctl.models.published import exponential_integrated
from hilctl.models.staged import FieldLag, StagedModel, Structure

Loops = Callable[..., list[SteadyLoop]]
GRID = [(a, f) for a in (3.0, 6.0) for f in (2.0, 50.0, 150.0, 250.0, 400.0)]


def truth(**stages: Any) -> StagedModel:
    """Return a known model; its deadbands lie where identification puts them."""
    omega = exponential_integrated(
        alpha=0.5,
        gamma_s=0.0,
        a_0=3.0,
        alpha_0=1.4,
        beta_0=0.3,
        g_0=1.0,
        alpha_1=0.08,
        beta_1=0.15,
        d_p=6.0,
        alpha_2=0.1,
        beta_2=0.4,
        d_n=6.0,
        plays=8,
        deadbands_a_side=5,
    )
    return StagedModel.around(omega, **stages)


def fit(data: list[SteadyLoop], **choices: Any) -> FittedModel:
    settings = FitSettings(kind="staged", plays=8, deadbands=5, starts=2, **choices)
    return fit_model(data, settings, lambda: 0.0)


@pytest.fixture
def data(loops_of: Loops) -> StagedFitData:
    loops = loops_of(truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3)), GRID[::3])
    return StagedFitData(loops, FitData(loops).speeds)


def start(data: StagedFitData, layers: Layers, before: list[float], delay_s: float) -> Point:
    scale = np.ones(data.target_um.size)
    return convex_start(data, layers, np.array(before), delay_s, scale).point


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


@pytest.mark.parametrize(
    ("layers", "before"),
    [
        (Layers(6, 4, least_delay_s=1e-5), [1e-4, 0.3, 0.8, 0.0]),
        (Layers(6, 4, lag=False, gamma=True, structure=False, delay=False), [0.0, 0.0, 0.8, 2e-4]),
    ],
)
def test_derivatives_agree_with_differences(
    data: StagedFitData, layers: Layers, before: list[float]
) -> None:
    """Analytic derivatives by every parameter equal central differences."""
    point = start(data, layers, before, 3e-5 if layers.lag else 0.0)
    point = replace(point, weights=point.weights + 0.1)  # a weight of 0 has no relative step
    x = point.pack()
    _, slopes = error_and_slopes(data, layers, point)
    low, high = bounds(data, layers, point)
    for i in np.flatnonzero(high > low):
        step = np.zeros(x.size)
        step[i] = 1e-6 * max(abs(x[i]), 1e-3 if i > 6 else 1e-12)
        above, _ = error_and_slopes(data, layers, point.unpack(x + step))
        below, _ = error_and_slopes(data, layers, point.unpack(x - step))
        numeric = (above - below) / (2.0 * step[i])
        assert np.linalg.norm(slopes[:, i] - numeric) < 0.02 * np.linalg.norm(numeric) + 1e-9, i


def test_weights_follow_without_a_search(data: StagedFitData) -> None:
    """With lag, spacing and delay known, the linear problem alone is within 1 % of the stroke."""
    layers = Layers(8, 5, structure=False)
    point = start(data, layers, [1e-4, 0.3, 0.5, 0.0], data.half_period_s)
    errors, _ = error_and_slopes(data, layers, point)
    assert np.max(np.abs(errors)) < 0.01 * data.stroke_um


def test_peak_goal_lowers_the_peak(loops_of: Loops) -> None:
    """With a goal in reach the peak error falls below that of least squares."""
    made = truth(lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3))
    loops = loops_of(made, GRID[::2])
    choices: dict[str, Any] = {"structure": False, "delay": False, "lag": "plain"}
    plain = fit(loops, **choices)
    refined = fit(loops, peak_goal_percent=0.8 * plain.peak_percent, **choices)
    assert refined.peak_percent < plain.peak_percent


def test_whole_histories_and_wrong_choices_are_refused(loops_of: Loops) -> None:
    """Dynamics need steady loops; stages belong to staged models."""
    command = 3.0 * np.sin(0.02 * np.arange(2000))
    history = History("growing", command, 5.0 * command, 10_000.0)
    with pytest.raises(DataError, match=r"found from steady loops.*leave out --whole"):
        fit([history])  # type: ignore[list-item]
    loops = loops_of(truth(), GRID[:2])
    with pytest.raises(DataError, match="found from runs at one sample rate"):
        fit([loops[0], replace(loops[1], sample_rate_hz=10_000.0)])


def test_preisach_triangle_is_nearer_between_known_stages(loops_of: Loops) -> None:
    """A triangle in place of plays and deadbands meets loops whose plays bend one by one."""
    stages: dict[str, Any] = {
        "lag": FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        "structure": Structure(natural_hz=2300.0, damping_ratio=0.15),
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
