"""The linear problem: what it finds is what was left, and a model of it has an inverse."""

import numpy as np
import pytest

from hilctl.identify.refine.residual_fit import CREEP_S, ResidualFit
from hilctl.models.refined import LEAST_SLOPE, RefinedModel
from tests.unit.identify.refine.conftest import OLD, RATE_HZ, actuator, history


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
    """The base is run once and the operator on top; a run of the whole gives the same bits."""
    runs = [history(actuator(offset_um=2.0), i) for i in range(2)]
    remainder = ResidualFit(OLD, runs, runs)
    model = remainder.model(solved(remainder))
    whole = model.forward(RATE_HZ).process(runs[1].command)
    np.testing.assert_allclose(remainder.modelled_um(model, 1), whole, atol=1e-12)


def test_numbers_that_have_no_inverse_become_less():
    """By one factor, until the least slope is there."""
    runs = [history(actuator(), i) for i in range(2)]
    remainder = ResidualFit(OLD, runs, runs)
    numbers = np.zeros(remainder.size)
    numbers[:12] = -3.0
    model = remainder.model(numbers)
    assert model.residual.least_slope == pytest.approx(1.1 * LEAST_SLOPE, rel=1e-6)
    assert len(set(np.array(model.residual.slopes)[0].tolist())) == 1


def test_old_operator_is_what_anchors_hold_to():
    """Without runs that say otherwise, a refined model stays what it was."""
    runs = [history(actuator(), i, noise_um=0.0) for i in range(2)]
    first = ResidualFit(OLD, runs, runs)
    once = first.model(solved(first))
    again = ResidualFit(once, runs[:1], runs[:1])
    numbers = np.linalg.solve(
        again.anchor().normal + again.firm(1e-4, again.anchor()), again.anchor().right
    )
    found = again.model(numbers)
    assert isinstance(found, RefinedModel)
    change = again.modelled_um(found, 0) - again.modelled_um(once, 0)
    shown = again.modelled_um(once, 0) - again.modelled_um(OLD, 0)
    assert np.std(change) < 0.25 * np.std(shown)


def test_drift_of_a_run_changes_nothing_where_it_is_its_own():
    """Whatever a run's constant, creep and line, the sums stay nearly what they were."""
    still, moving = history(actuator(), 1), history(actuator(), 1)
    time_s = np.arange(moving.command.size) / RATE_HZ
    moving.displacement_um[:] += 5.0 + 3.0 * np.log1p(time_s / CREEP_S) - 4.0 * time_s
    right = [ResidualFit(OLD, [run], [still]).moments(own=True)[0].right for run in (still, moving)]
    bare = [ResidualFit(OLD, [run], [still]).moments(own=False)[0].right for run in (still, moving)]
    assert np.linalg.norm(right[1] - right[0]) < 0.05 * np.linalg.norm(bare[1] - bare[0])
