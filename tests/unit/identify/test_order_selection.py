"""Model order by loops held out, lag of a table, and the same fits on other workers."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.fit_api import ignore_progress
from hilctl.identify.fit_model import fit_model
from hilctl.identify.order_selection import ORDERS, choose_lag, choose_order
from hilctl.identify.parallel import serial_map
from hilctl.identify.settings import FitSettings
from hilctl.models.integrated import exponential_integrated
from hilctl.models.plays import PpiModel
from tests.published import terfenol_rdpi

Loops = Callable[..., list[SteadyLoop]]
POINTS = 150
GRID = [(a, f) for a in (2.0, 3.0, 6.0) for f in (10.0, 100.0, 250.0)]


@pytest.fixture
def loops(loops_of: Loops) -> list[SteadyLoop]:
    omega = exponential_integrated(
        alpha=0.9, gamma_s=2e-4, a_0=3.0, alpha_0=1.4, beta_0=0.3, g_0=1.0, alpha_1=0.08,
        beta_1=0.15, d_p=8.0, alpha_2=0.1, beta_2=0.4, d_n=8.0, plays=6, deadbands_a_side=4,
    )  # fmt: skip
    return loops_of(omega, GRID, POINTS)


@pytest.mark.slow
def test_smallest_order_that_is_as_good_is_chosen(loops: list[SteadyLoop]) -> None:
    """Loops of 6 plays on a noisy sensor are not given 28; every order's error is told."""
    rng = np.random.default_rng(2)
    noisy = [
        replace(loop, displacement_um=loop.displacement_um + rng.normal(0.0, 0.3, POINTS))
        for loop in loops
    ]
    settings = FitSettings(kind="integrated", weights="free")
    chosen, errors = choose_order(noisy, settings, serial_map, ignore_progress)
    assert [error.plays for error in errors] == [plays for plays, _ in ORDERS]
    assert chosen.plays <= 12
    assert chosen.starts == settings.starts
    least = min(error.rms_percent for error in errors)
    (own,) = (error for error in errors if error.plays == chosen.plays)
    assert own.rms_percent <= 1.03 * least
    assert own.deadbands_a_side == chosen.deadbands


@pytest.mark.slow
def test_models_without_deadbands_have_none(loops_of: Loops) -> None:
    """The order of an RDPI is its plays alone."""
    data = loops_of(terfenol_rdpi(), [(2.3, f) for f in (1.0, 50.0, 100.0, 200.0)], POINTS)
    settings = FitSettings(kind="rdpi", weight_by="equal")
    chosen, errors = choose_order(data, settings, serial_map, ignore_progress)
    assert chosen.plays in {error.plays for error in errors}
    assert all(error.deadbands_a_side == 0 for error in errors)
    with pytest.raises(DataError, match="needs at least 4, got 3"):
        choose_order(data[:3], settings, serial_map, ignore_progress)


@pytest.mark.slow
def test_lag_of_a_table_is_found() -> None:
    """A displacement recorded three samples late is seen to lag by three."""
    stage = PpiModel(
        input_unit="V", direct=1.0, weights=(0.5, 0.3, 0.2), thresholds=(0.2, 0.5, 0.9)
    )
    time = np.arange(1500)
    command = 1.8 + 1.8 * np.sin(2.0 * np.pi * time / 200.0) * np.linspace(0.2, 1.0, 1500)
    late = np.roll(stage.forward(200.0).process(command), 3)

    def load(lag: int) -> Sequence[History]:
        return [History("stage", command, late, 200.0, ignore=10).without_lag(lag)]

    settings = FitSettings(kind="ppi", weights="free", offset=True)
    assert choose_lag(load, settings, serial_map, ignore_progress) == 3


def test_creep_and_zero_of_each_history_are_taken_out() -> None:
    """Two runs whose sensor was set to zero anew, and that creep, give the weights all the same."""
    truth = PpiModel(direct=1.0, weights=(0.8, 0.4), thresholds=(0.5, 1.0))
    time = np.arange(2000)
    command = 2.0 * np.sin(2.0 * np.pi * time / 200.0) * np.linspace(0.3, 1.0, 2000)
    clean = truth.forward(200.0).process(command)
    data = [
        History(f"run {i}", command, clean + zero + creep * np.log1p(time / 20.0), 200.0, 10)
        for i, (zero, creep) in enumerate([(3.0, 0.2), (-5.0, 0.1)])
    ]
    choices: dict[str, Any] = {"plays": 4, "weights": "free", "starts": 1}
    for creep, low, high in ((True, 0.0, 0.02), (False, 5.0, 100.0)):
        settings = FitSettings(kind="ppi", creep=creep, offset=True, **choices)
        found = fit_model(data, settings, lambda: 0.0)
        assert low <= found.peak_percent <= high
