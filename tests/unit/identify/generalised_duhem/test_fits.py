"""A fit of the generalised Duhem operator to histories of one, and of a model that it is not."""

from functools import cache

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.evaluation import judge
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.settings import FitSettings
from hilctl.models.effective_field import FieldLosses
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.staged import StagedModel
from tests.unit.models.test_generalised_duhem import duhem_model

RATE_HZ = 20_000.0
SETTINGS = FitSettings(kind="generalised_duhem", cells=10, across=8)


def command(seed: int) -> F64:
    """Return a random command from rest, small parts of it after large ones: float64[n]."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(0.9 * RATE_HZ)) / RATE_HZ
    sines = [np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in rng.uniform(4.0, 160.0, 12)]
    wave = np.sum(sines, axis=0)
    return np.ascontiguousarray(5.0 * np.minimum(t / 0.02, 1.0) * wave / np.abs(wave).max())


def truth() -> StagedModel:
    """Return what the data come from."""
    hysteresis = duhem_model(losses=FieldLosses(field_s=1e-4, output_s=5e-6))
    structure = FirstMode(natural_hz=1500.0, damping_ratio=0.2)
    return StagedModel.around(hysteresis, structure=structure, delay_s=5e-5)


def history(seed: int, noise_um: float = 0.0, samples: int | None = None) -> History:
    """Return a record of the known model."""
    v = np.ascontiguousarray(command(seed)[:samples])
    noise = noise_um * np.random.default_rng(seed).standard_normal(v.size)
    return History("random", v, truth().forward(RATE_HZ).process(v) + noise, RATE_HZ)


@cache
def found() -> FittedModel:
    """Return what is identified."""
    return fit_model([history(1, 0.01)], SETTINGS, lambda: 0.0)


@pytest.mark.slow
def test_a_history_that_was_not_fitted_is_met() -> None:
    judged = judge(found().model, [history(2)])
    assert judged.rms_percent < 0.1
    assert judged.peak_percent < 1.5


def test_the_stages_are_found() -> None:
    parameters = found().parameters
    assert parameters["field_s"] == pytest.approx(1e-4, rel=0.3)
    assert parameters["output_s"] == pytest.approx(5e-6, rel=0.3)
    assert parameters["natural_hz"] == pytest.approx(1500.0, rel=0.2)
    assert parameters["output_offset_um"] == pytest.approx(0.7, abs=0.1)


def test_the_table_is_of_the_size_that_was_asked_for() -> None:
    model = found().model
    assert isinstance(model, StagedModel)
    hysteresis = model.hysteresis
    assert isinstance(hysteresis, GeneralisedDuhemModel)
    assert len(hysteresis.rising) == len(hysteresis.falling) == SETTINGS.cells + 1
    assert {len(row) for row in hysteresis.rising} == {SETTINGS.across + 1}
    assert found().numbers == 2 * (SETTINGS.cells + 1) * (SETTINGS.across + 1) + 14


@pytest.mark.slow
def test_records_begin_at_rest_each() -> None:
    """Two that were cut in the middle of a motion, each with its rest before it."""
    both = fit_model([history(1, 0.01, 9000), history(3, 0.01, 9000)], SETTINGS, lambda: 0.0)
    assert judge(both.model, [history(2)]).rms_percent < 0.2


def test_steady_loops_are_refused() -> None:
    wave = np.sin(2.0 * np.pi * np.arange(64) / 64)
    loop = SteadyLoop("3 A 10 Hz", 3.0 * wave, 20.0 * wave, 10.0, RATE_HZ)
    with pytest.raises(DataError, match="not from steady loops: 3 A 10 Hz"):
        fit_model([loop], SETTINGS, lambda: 0.0)
