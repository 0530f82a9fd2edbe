"""A delay goes into the model's own stage; an error of the loops' width does not."""

import numpy as np
import pytest

from hilctl.identify.refine.delay import delayed_model, fastest_um_per_s
from hilctl.models.integrated import ButterflyModel, DeadbandFunction
from hilctl.models.staged import StagedModel
from tests.unit.identify.refine.conftest import OLD, actuator, history


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
    """Its window would have no end otherwise."""
    run = history(OLD, 1)
    steps = np.repeat([0.0, 5.0, -5.0], 2000)
    assert fastest_um_per_s([steps], [run]) == pytest.approx(0.1 * run.sample_rate_hz)


def test_wider_loops_are_no_delay():
    """Plays and drags that a model has not are left to the operator."""
    assert delayed_model(OLD, [history(actuator(), i) for i in range(3)]) is OLD


def test_a_kind_without_stages_stays_as_it_is():
    model = ButterflyModel(
        direct=1.0, weights=(), thresholds=(), bias=3.0, shape=DeadbandFunction(slope=2.0)
    )
    assert delayed_model(model, [history(OLD, 1)]) is model
    assert np.isfinite(history(OLD, 1).displacement_um).all()
