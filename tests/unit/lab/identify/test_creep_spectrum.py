"""Creep of histories: identified from what no play of the command explains."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.identify.creep_spectrum import (
    creep_of,
    creeps,
    without_creep,
    without_fastest,
)
from hilctl.lab.identify.data.records import History
from hilctl.models.linear_stages import CreepModel
from hilctl.models.plays import PpiModel

SLOW_HZ = 1000.0
MODEL = PpiModel(
    input_unit="A", direct=5.0, weights=(2.0, 2.0), thresholds=(0.5, 2.0), output_offset_um=-4.0
)
CREEP = CreepModel(time_constants_s=(0.14, 1.7, 19.0), shares=(0.012, 0.02, 0.03))
NOISE_UM = 0.01


def command(levels=(5.0, -5.0, 0.0), rest_s=3.0):
    time_s = np.arange(2000) / SLOW_HZ
    parts = [2.5 * time_s * np.sin(2.0 * np.pi * 5.0 * time_s)]
    last = 0.0
    for level in levels:
        parts += [np.linspace(last, level, 100), np.full(int(rest_s * SLOW_HZ), level)]
        last = level
    return np.concatenate(parts)


def history(creep=CREEP, *, heat=0.0, drift=0.0, noise_um=NOISE_UM, **levels):
    v = command(**levels)
    x_um = MODEL.forward(SLOW_HZ).process(v)
    y_um = x_um if creep is None else creep.forward(SLOW_HZ, rest_um=-4.0).process(x_um)
    warmed = heat * np.cumsum(v**2) / SLOW_HZ + drift * np.arange(v.size) / SLOW_HZ
    noise = noise_um * np.random.default_rng(2).standard_normal(v.size)
    return History("h", v, y_um + warmed + noise, SLOW_HZ), x_um


def crept(creep, time_s):
    """Return what a step has crept by after a time, of itself."""
    times_s, shares = np.array(creep.time_constants_s), np.array(creep.shares)
    return -np.expm1(-np.outer(time_s, 1.0 / times_s)) @ shares


@pytest.mark.parametrize(("heat", "drift"), [(0.0, 0.0), (0.06, 0.0), (0.0, 0.5)])
def test_what_a_step_creeps_by_is_found_whatever_the_time_constants(heat, drift):
    records = [history(heat=heat, drift=drift)[0]]
    assert creeps(records)
    found = creep_of(records)
    time_s = np.array([0.1, 0.3, 1.0, 3.0])
    np.testing.assert_allclose(crept(found, time_s), crept(CREEP, time_s), rtol=0.0, atol=2e-3)
    assert not set(found.time_constants_s) & set(CREEP.time_constants_s)


@pytest.mark.parametrize("bend", [0.0, 0.004, -0.004])
def test_a_bend_is_found_only_if_creep_is_bent(bend):
    """Displacements of 40 um either way: slopes of the root from 0.6 to 1.7 of the one at rest."""
    records = [history(CREEP.model_copy(update={"bend_per_um": bend}))[0]]
    found = creep_of(records)
    assert found.bend_per_um == pytest.approx(bend, rel=0.3)
    assert sum(found.shares) == pytest.approx(sum(CREEP.shares), rel=0.3)


def test_what_is_left_is_the_displacement_without_creep():
    record, x_um = history()
    (bare,) = without_creep([record], creep_of([record]))
    assert np.abs(record.displacement_um - x_um).max() > 1.2
    error_um = bare.displacement_um - x_um
    assert np.abs(error_um - error_um[0]).max() < 0.1 + 6.0 * NOISE_UM
    assert (bare.label, bare.ignore) == (record.label, record.ignore)


@pytest.mark.parametrize("others", [{}, {"heat": 0.02}, {"drift": 0.05}, {"noise_um": 0.05}])
def test_nothing_creeps_where_nothing_does(others):
    records = [history(None, **others)[0]]
    assert not creeps(records)
    assert creep_of(records) is None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("each_um", [0.03, 0.3, 3.0])
def test_slow_wandering_is_not_creep(seed, each_um):
    record, _ = history(None)
    at = np.arange(record.command.size) / SLOW_HZ
    walk = np.cumsum(np.random.default_rng(seed).standard_normal(60))
    wander_um = each_um * np.interp(at, 0.25 * np.arange(60), walk)
    moving = replace(record, displacement_um=record.displacement_um + wander_um)
    assert creep_of([moving]) is None


def test_too_few_rests_tell_nothing():
    assert creep_of([history(levels=(), rest_s=1.0)[0]]) is None
    assert creep_of([history(levels=(5.0,), rest_s=3.0)[0]]) is None
    assert creep_of([history(rest_s=0.3)[0]]) is None


def test_steady_loops_stay_as_they_are(loop_of):
    loop = loop_of(MODEL, 4.0, 10.0)
    assert creep_of([loop]) is None
    assert without_creep([loop], CREEP) == (loop,)


def test_creep_of_earlier_motions_is_told_from_that_of_a_record():
    v = command()
    y_um = CREEP.forward(SLOW_HZ, rest_um=-4.0).process(
        MODEL.forward(SLOW_HZ).process(np.concatenate((v, v[::-1], v)))
    )[-v.size :]
    assert abs(y_um[0] + 4.0) > 10.0 * NOISE_UM
    noise = NOISE_UM * np.random.default_rng(2).standard_normal(v.size)
    found = creep_of([History("h", v, y_um + noise, SLOW_HZ, ignore=1900)])
    time_s = np.array([0.1, 0.3, 1.0, 3.0])
    np.testing.assert_allclose(crept(found, time_s), crept(CREEP, time_s), rtol=0.0, atol=3e-3)


def test_the_fastest_elements_can_be_left_out():
    creep = CreepModel(time_constants_s=(0.01, 0.1), shares=(0.01, 0.02), bend_per_um=0.1)
    slow = CreepModel(time_constants_s=(0.1,), shares=(0.02,), bend_per_um=0.1)
    assert without_fastest(creep) == slow
    assert without_fastest(slow) == slow
    assert without_fastest(creep.model_copy(update={"time_constants_s": (0.01, 0.015)})) is None
