"""The coil's heat through runs and pauses."""

import numpy as np
import pytest

from hilctl.characterise.heat import CampaignHeat
from hilctl.experiment.forecast import CoilHeat
from hilctl.experiment.load import load_experiment

RATE_HZ = 5000.0
BUDGET = ["limits.rms_current_a=1.0", "limits.thermal_time_constant_s=10.0"]


@pytest.fixture
def heat(experiment):
    return CampaignHeat(load_experiment(experiment, BUDGET).config, 100.0)


def held(amps, seconds):
    return np.full(round(seconds * RATE_HZ), amps)


def test_without_a_budget_nothing_is_waited_for(experiment):
    cold = CampaignHeat(load_experiment(experiment).config, 0.0)
    cold.run(held(4.0, 5.0), 5.0)
    assert cold.pause_s(held(4.0, 5.0), 5.0) == 0.0


def test_a_cold_coil_runs_at_once(heat):
    assert heat.pause_s(held(2.0, 1.0), 100.0) == 0.0


def test_the_pause_is_just_long_enough(heat, experiment):
    """After it the run keeps the budget, as the interlock counts it; a little less does not do."""
    run = held(2.5, 1.0)
    heat.run(run, 101.0)
    pause_s = heat.pause_s(run, 101.0)
    assert pause_s > 1.0
    config = load_experiment(experiment, BUDGET).config
    before_a2 = heat.rms_a**2
    for waited_s, kept in ((pause_s, True), (0.8 * pause_s, False)):
        then = CoilHeat(config, before_a2 * np.exp(-waited_s / 10.0))
        then.add(run)
        assert (then.highest_a2 <= 0.981) is kept


def test_time_that_passes_anyway_is_no_pause(heat):
    heat.run(held(2.5, 1.0), 101.0)
    assert heat.pause_s(held(2.5, 1.0), 200.0) == 0.0


def test_a_run_that_never_fits_is_waited_for_no_longer_than_for_a_cold_coil(heat):
    """The amplitude was lowered before; here it was not."""
    heat.run(held(2.5, 1.0), 101.0)
    assert heat.pause_s(held(4.0, 5.0), 101.0) < 100.0
