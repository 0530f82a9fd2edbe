"""A kind of model is fitted to what is left of records without creep, and creeps itself."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History
from hilctl.identify.fit_kind import fit_kind
from hilctl.identify.settings import FitSettings
from hilctl.models.integrated import exponential_integrated
from hilctl.models.linear_stages import CreepModel, FurtherMode
from hilctl.models.staged import FieldLag, StagedModel

RATE_HZ = 2000.0
FIELD = FitSettings(kind="field", plays=8, drags=0, cells=8, knots=8)
OMEGA = exponential_integrated(
    alpha=0.3, gamma_s=0.0, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0, alpha_1=0.3, beta_1=0.1,
    d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8, plays=6, deadbands_a_side=2,
)  # fmt: skip
TRUTH = StagedModel.around(
    OMEGA,
    lag=FieldLag(tau_s=1e-3),
    creep=CreepModel(time_constants_s=(0.11, 1.3, 14.0), shares=(0.015, 0.02, 0.02)),
)


@pytest.fixture(scope="module")
def records():
    """A growing sine, rests on either side, and random motion."""
    time_s = np.arange(4000) / RATE_HZ
    parts = [2.0 * time_s * np.sin(2.0 * np.pi * 8.0 * time_s)]
    last = float(parts[0][-1])
    for level in (3.5, -3.5, 0.0):
        parts += [np.linspace(last, level, 200), np.full(3000, level)]
        last = level
    rng = np.random.default_rng(3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    waves = np.sin(2.0 * np.pi * np.outer(time_s, np.arange(2.0, 26.0, 2.0)) + phases).sum(axis=1)
    parts.append(4.0 * waves / np.abs(waves).max() * np.sin(np.pi * time_s / time_s[-1]))
    command = np.concatenate(parts)
    displacement_um = TRUTH.forward(RATE_HZ).process(command)
    return [History("made", command, displacement_um, RATE_HZ)]


def error_um(model, records):
    (record,) = records
    came = model.forward(record.sample_rate_hz).process(record.command)
    return float(np.sqrt(np.mean((came - record.displacement_um) ** 2)))


def test_the_model_creeps_and_fits_the_better_for_it(records):
    creeping = fit_kind(records, FIELD, "A")
    plain = fit_kind(records, FIELD.model_copy(update={"creep_stage": False}), "A")
    assert creeping.model.creep is not None
    assert plain.model.creep is None
    assert error_um(creeping.model, records) < 0.15 * error_um(plain.model, records)
    assert creeping.parameters["creep_share"] == pytest.approx(sum(creeping.model.creep.shares))
    assert "creep_share" not in plain.parameters


def test_the_range_is_that_of_the_displacement_with_creep(records):
    low_um, high_um = fit_kind(records, FIELD, "A").model.output_range_um
    (record,) = records
    assert (low_um, high_um) == (record.displacement_um.min(), record.displacement_um.max())


def test_known_modes_are_taken_off_the_records_and_put_into_the_model(records):
    mode = FurtherMode(
        natural_hz=150.0, damping_ratio=0.1, antiresonance_hz=140.0, antiresonance_damping_ratio=0.1
    )
    (record,) = records
    ringing_um = mode.forward(RATE_HZ).process(record.displacement_um)
    moved = [replace(record, displacement_um=ringing_um)]
    bare, with_it = fit_kind(records, FIELD, "A"), fit_kind(moved, FIELD, "A", modes=[mode])
    assert with_it.model.modes == (mode,)
    assert with_it.model.output_range_um == (ringing_um.min(), ringing_um.max())
    assert with_it.parameters["antiresonance_hz_2"] == mode.antiresonance_hz
    assert len(with_it.parameters) == len(bare.parameters) + 4
    assert with_it.numbers > bare.numbers  # weights that come out as 0 do not count
    assert error_um(with_it.model, moved) < 2.0 * error_um(bare.model, records)


def test_kinds_without_stages_have_no_creep(records):
    model = fit_kind(records, FitSettings(kind="ppi", plays=4), "A").model
    assert not hasattr(model, "creep")


def test_no_records_are_refused():
    with pytest.raises(DataError, match="nothing to identify a model from"):
        fit_kind([], FIELD, "A")
