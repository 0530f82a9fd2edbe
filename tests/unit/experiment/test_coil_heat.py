"""The coil's heat through runs and pauses."""

import math

import numpy as np
import pytest

from hilctl.base.samples import Flag, Samples
from hilctl.experiment.coil_heat import CoilHeat, CoolingCoil, cooled
from hilctl.experiment.load import load_experiment
from tests.fakes import DESCRIBED
from tests.unit.lab.studies.characterise.conftest import experiment

__all__ = ["experiment"]

RATE_HZ = 5000.0
BUDGET = ["limits.rms_current_a=1.0", "limits.thermal_time_constant_s=10.0"]


@pytest.fixture
def config(experiment):
    return load_experiment(experiment, BUDGET).config


@pytest.fixture
def coil(config):
    return CoolingCoil(config.rig(DESCRIBED), 0.0, 100.0)


def effect(config, parts, heat_a2=0.0):
    heat = CoilHeat(config.limits, RATE_HZ, heat_a2)
    for part in parts:
        heat.add(part)
    return heat.effect


@pytest.fixture
def held(config):
    def make(amps, seconds):
        command = np.full(round(seconds * RATE_HZ), float(amps))
        return effect(config, [command])

    return make


def samples(index, command, measured=None, flags=None):
    size = len(index)
    nothing = np.full(size, np.nan)
    return Samples(
        index=np.array(index, dtype=np.int64),
        reference_um=nothing,
        wanted=np.array(command, dtype=np.float64),
        command=np.array(command, dtype=np.float64),
        displacement_um=nothing,
        input_um=nothing,
        measured=np.empty(0) if measured is None else np.array(measured),
        flags=np.zeros(size, dtype=np.uint32) if flags is None else flags,
    )


def test_without_a_budget_nothing_is_waited_for(experiment):
    config = load_experiment(experiment).config
    run = effect(config, [np.full(25000, 4.0)])
    cold = CoolingCoil(config.rig(DESCRIBED), 0.0, 0.0)
    cold.ran(run, 5.0)
    assert cold.pause_s(run, 5.0) == 0.0


def test_the_pause_is_just_long_enough(coil, held, config):
    run = held(2.5, 1.0)
    coil.ran(run, 101.0)
    pause_s = coil.pause_s(run, 101.0)
    assert pause_s > 1.0
    for waited_s, kept in ((pause_s, True), (0.8 * pause_s, False)):
        then = CoilHeat(config.limits, RATE_HZ, coil.heat_a2(101.0 + waited_s))
        then.add(np.full(5000, 2.5))
        assert (then.highest_a2 <= 0.901) is kept


@pytest.mark.parametrize("heat_a2", [0.0, 0.5])
def test_in_parts_and_from_any_heat_a_run_does_the_same(config, heat_a2):
    command = np.sin(np.arange(9000) / 50.0) * 2.0
    whole = effect(config, [command])
    parts = effect(config, np.split(command, 3), heat_a2)
    assert parts.seconds == pytest.approx(whole.seconds)
    assert parts.alone_a2 == pytest.approx(whole.alone_a2, rel=1e-12)
    assert parts.hottest_a2 == pytest.approx(whole.hottest_a2, rel=1e-9)
    sure = CoilHeat(config.limits, RATE_HZ, whole.hottest_a2)
    sure.add(command)
    assert sure.highest_a2 == pytest.approx(0.9, rel=1e-9)


def test_it_cools_to_what_is_asked_for(coil, held):
    coil.ran(held(2.5, 1.0), 101.0)
    pause_s = coil.pause_s(held(0.1, 0.1), 101.0, 0.2)
    assert coil.heat_a2(101.0 + pause_s) == pytest.approx(0.04)


def test_a_run_that_never_fits_is_waited_for_no_longer_than_for_a_cold_coil(coil, held):
    coil.ran(held(2.5, 1.0), 101.0)
    assert coil.pause_s(held(4.0, 5.0), 101.0) < 100.0


def test_a_clock_that_goes_back_cools_nothing():
    assert cooled(4.0, 0.0, 10.0, -5.0) == 4.0
    assert cooled(4.0, 1.0, 10.0, 10.0) == pytest.approx(1.0 + 3.0 / math.e)


class TestSamples:
    def test_what_was_measured_counts_where_it_is_more(self, config):
        heat, sure = (CoilHeat(config.limits, RATE_HZ, 0.5) for _ in range(2))
        heat.follow(samples(range(4), [1, 1, 1, 1], [np.nan, 3.0, np.inf, 0.5]))
        sure.add(np.array([1.0, 3.0, 1.0, 1.0]))
        assert heat.heat_a2 == sure.heat_a2

    def test_in_a_gap_the_output_was_held(self, config):
        heat, sure = (CoilHeat(config.limits, RATE_HZ, 0.0) for _ in range(2))
        heat.follow(samples([0, 1], [1, 2]))
        heat.follow(samples([2, 5000, 5001], [2, 1, 1]))
        sure.add(np.array([1.0] + [2.0] * 4999 + [1.0, 1.0]))
        assert heat.heat_a2 == pytest.approx(sure.heat_a2, rel=1e-9)

    def test_a_ramp_at_the_start_says_how_hot_the_output_has_kept_it(self, config):
        heat = CoilHeat(config.limits, RATE_HZ, 0.0)
        heat.follow(samples([0], [0.9], flags=np.array([Flag.RAMP], dtype=np.uint32)))
        assert heat.heat_a2 == pytest.approx(0.81)
