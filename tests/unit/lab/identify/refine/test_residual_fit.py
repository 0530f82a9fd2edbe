"""A delay goes into the model's own stage; an error of the loops' width does not."""

import numpy as np
import pytest

from hilctl.lab.identify.refine.residual_fit import (
    CREEP_S,
    ResidualFit,
    delayed_model,
    fastest_um_per_s,
)
from hilctl.models.integrated import ButterflyModel, DeadbandFunction
from hilctl.models.refined import LEAST_SLOPE
from hilctl.models.staged import StagedModel
from tests.unit.lab.identify.refine.conftest import OLD, RATE_HZ, actuator, history


@pytest.mark.parametrize("delay_s", [4e-4, 1.1e-3])
def test_delay_that_the_runs_have_is_found(delay_s):
    truth = StagedModel.around(OLD, delay_s=delay_s)
    found = delayed_model(OLD, [history(truth, i) for i in range(3)])
    assert isinstance(found, StagedModel)
    assert found.delay_s == pytest.approx(delay_s, rel=0.05)


def test_a_delay_too_long_is_taken_back():
    truth, old = (StagedModel.around(OLD, delay_s=d) for d in (3e-4, 9e-4))
    found = delayed_model(old, [history(truth, i) for i in range(3)])
    assert isinstance(found, StagedModel)
    assert found.delay_s == pytest.approx(3e-4, rel=0.1)


def test_a_run_that_only_steps_has_a_speed():
    run = history(OLD, 1)
    steps = np.repeat([0.0, 5.0, -5.0], 2000)
    assert fastest_um_per_s([steps], [run]) == pytest.approx(0.1 * run.sample_rate_hz)


def test_wider_loops_are_no_delay():
    assert delayed_model(OLD, [history(actuator(), i) for i in range(3)]) is OLD


def test_a_kind_without_stages_stays_as_it_is():
    model = ButterflyModel(
        direct=1.0, weights=(), thresholds=(), bias=3.0, shape=DeadbandFunction(slope=2.0)
    )
    assert delayed_model(model, [history(OLD, 1)]) is model
    assert np.isfinite(history(OLD, 1).displacement_um).all()


def solved(remainder, strength=0.003, *, own=False):
    moments = remainder.moments(own=own)
    total = remainder.anchor()
    for each in moments:
        total += each
    return np.linalg.solve(total.normal + remainder.firm(strength, total), total.right)


def test_what_is_left_is_found():
    runs = [history(actuator(), i, noise_um=0.0) for i in range(3)]
    remainder = ResidualFit(OLD, runs, runs)
    model = remainder.model(solved(remainder))
    for number, run in enumerate(runs):
        error = remainder.modelled_um(model, number) - run.displacement_um
        was = remainder.modelled_um(OLD, number) - run.displacement_um
        assert np.std(error) < 0.15 * np.std(was)


def test_modelled_displacement_is_that_of_the_model():
    runs = [history(actuator(offset_um=2.0), i) for i in range(2)]
    remainder = ResidualFit(OLD, runs, runs)
    model = remainder.model(solved(remainder))
    whole = model.forward(RATE_HZ).process(runs[1].command)
    np.testing.assert_allclose(remainder.modelled_um(model, 1), whole, atol=1e-12)


def test_numbers_that_have_no_inverse_become_less():
    runs = [history(actuator(), i) for i in range(2)]
    remainder = ResidualFit(OLD, runs, runs)
    numbers = np.zeros(remainder.size)
    numbers[:12] = -3.0
    model = remainder.model(numbers)
    assert model.residual.least_slope == pytest.approx(1.1 * LEAST_SLOPE, rel=1e-6)
    assert len(set(np.array(model.residual.slopes)[0].tolist())) == 1


def test_drift_of_a_run_changes_nothing_where_it_is_its_own():
    still, moving = history(actuator(), 1), history(actuator(), 1)
    time_s = np.arange(moving.command.size) / RATE_HZ
    moving.displacement_um[:] += 5.0 + 3.0 * np.log1p(time_s / CREEP_S) - 4.0 * time_s
    right = [ResidualFit(OLD, [run], [still]).moments(own=True)[0].right for run in (still, moving)]
    bare = [ResidualFit(OLD, [run], [still]).moments(own=False)[0].right for run in (still, moving)]
    assert np.linalg.norm(right[1] - right[0]) < 0.05 * np.linalg.norm(bare[1] - bare[0])
