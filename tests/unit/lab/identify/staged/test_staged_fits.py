"""Lag, hysteresis, structure and delay are found again together from their own loops."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_data import SPACING, Linear
from hilctl.lab.identify.staged.objective import (
    DYNAMIC,
    Layers,
    Point,
    error_and_slopes,
    parameters,
)
from hilctl.lab.identify.staged.staged_fits import StagedEnd, at_bound, standard_errors
from hilctl.models.linear_stages import FirstMode
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.staged import FieldLag
from tests.staged import GRID, fit, start, truth


def test_all_stages_are_found_again(loops_of):
    made = truth(
        lag=FieldLag(tau_s=1e-4, growth_per_unit=0.3),
        structure=FirstMode(natural_hz=2300.0, damping_ratio=0.15),
        delay_s=3e-5,
    )
    found = fit(loops_of(made, GRID))
    assert found.own_peak_percent < 0.3
    assert found.model.lag.tau_s == pytest.approx(1e-4, rel=0.02)
    assert found.model.lag.growth_per_unit == pytest.approx(0.3, rel=0.05)
    assert found.model.structure.natural_hz == pytest.approx(2300.0, rel=0.05)
    lateness_s = found.model.delay_s + found.model.structure.damping_ratio / (np.pi * 2300.0)
    assert lateness_s == pytest.approx(3e-5 + 0.15 / (np.pi * 2300.0), abs=3e-6)
    assert found.standard_errors.keys() <= found.parameters.keys() - {"g_0", "gamma"}
    for name in ("tau_s", "growth_per_unit", "natural_hz", "damping_ratio", "delay_s", "a_0"):
        assert 0.0 < found.standard_errors[name] < abs(found.parameters[name])
    assert parse_model("x.yaml", dump_model(found.model)) == found.model


def test_errors_are_those_of_the_run(loops_of):
    made = truth(
        lag=FieldLag(tau_s=1.5e-4, growth_per_unit=0.2),
        structure=FirstMode(natural_hz=2000.0, damping_ratio=0.2),
        delay_s=5.3e-5,
    )
    assert judge(made, loops_of(made, GRID)).own_peak_percent < 0.05
    rigid = truth(delay_s=5.3e-5)
    assert judge(rigid, loops_of(rigid, GRID)).own_peak_percent < 0.05


def test_stages_that_are_not_there_have_no_effect(loops_of):
    """A plain lag of a rigid rod: whatever is fitted for the other stages."""
    found = fit(loops_of(truth(lag=FieldLag(tau_s=1e-4)), GRID))
    late_s = found.model.delay_s
    late_s += found.model.structure.damping_ratio / (np.pi * found.model.structure.natural_hz)
    assert found.model.lag.tau_s + late_s == pytest.approx(1e-4, rel=0.02)
    assert found.own_peak_percent < 0.3


def test_at_a_low_rate_the_delay_is_that_of_the_sampled_lag(loops_of):
    """At 1 kHz a lag of 0.1 ms is a whole sample late: half of it is no delay of the actuator."""
    slow = [(a, f / 10.0) for a, f in GRID]
    found = fit(loops_of(truth(lag=FieldLag(tau_s=1e-4)), slow, rate_hz=1000.0))
    assert found.model.delay_s < 5e-5
    assert found.own_peak_percent < 1.0


def test_a_low_pass_behind_the_plant_is_a_structure(loops_of):
    """That of a sensor, of 1 kHz and first order: no resonance, and no mass to find."""
    loops = []
    for loop in loops_of(truth(lag=FieldLag(tau_s=1e-4)), GRID):
        s = 2j * np.pi * loop.frequency_hz * np.arange(loop.command.size // 2 + 1)
        slower = np.fft.rfft(loop.displacement_um) / (1.0 + s / (2.0 * np.pi * 1000.0))
        passed = np.fft.irfft(slower, loop.command.size)
        loops.append(replace(loop, displacement_um=passed))
    assert fit(loops).own_peak_percent < 1.0


LAYERS = Layers(plays=1, deadbands=0, stages=False)
SIZE, RECORDS, EACH = DYNAMIC + 2 + 3, 40, 30
POINT = Point(np.zeros(4), Linear(), 1.0, np.ones(1), (1.0, 1.0), np.zeros(0), np.zeros(0), 0.0)
BY = parameters(LAYERS, POINT)
PLACES = tuple(slice(EACH * i, EACH * (i + 1)) for i in range(RECORDS))


def ended(noise_um, free, seed=1, bound=()):
    """Where a search ended whose errors are each record's own deviation of a_0."""
    rng = np.random.default_rng(seed)
    slopes = np.zeros((RECORDS * EACH, SIZE))
    slopes[:, DYNAMIC] = np.tile(np.linspace(-1.0, 1.0, EACH), RECORDS)
    slopes[:, SPACING] = rng.normal(size=RECORDS * EACH)
    own = rng.normal(0.0, noise_um, RECORDS)
    errors = slopes[:, DYNAMIC] * np.repeat(own - own.mean(), EACH)
    mask = np.zeros(SIZE, dtype=bool)
    mask[list(free)] = True
    held = np.zeros(SIZE, dtype=bool)
    held[list(bound)] = True
    return StagedEnd(POINT, errors, slopes, mask, held, np.ones(RECORDS * EACH), ())


def test_records_that_differ_by_so_much_give_so_much_over_their_root():
    """Each record's own a_0 scatters by 0.5: the mean of 40 is known to 0.5 / sqrt(40)."""
    found = standard_errors(ended(0.5, [DYNAMIC]), BY, PLACES)
    assert found.keys() == {"a_0"}
    assert found["a_0"] == pytest.approx(0.5 / np.sqrt(RECORDS), rel=0.25)


def test_a_parameter_that_was_not_free_has_none():
    free = standard_errors(ended(0.5, [DYNAMIC, SPACING]), BY, PLACES)
    assert free.keys() == {"a_0", "alpha"}


def test_one_record_disagrees_with_nobody():
    assert standard_errors(ended(0.5, [DYNAMIC]), BY, PLACES[:1]) == {}


def test_what_a_bound_holds_is_named():
    held = at_bound(ended(0.5, [], bound=[0, SPACING, DYNAMIC + 1]), BY)
    assert held == ("alpha", "a_1")


def test_whole_histories_and_wrong_choices_are_refused(loops_of):
    command = 3.0 * np.sin(0.02 * np.arange(2000))
    history = History("growing", command, 5.0 * command, 10_000.0)
    with pytest.raises(DataError, match=r"--whole"):
        fit([history])
    loops = loops_of(truth(), GRID[:2])
    with pytest.raises(DataError, match="one sample rate"):
        fit([loops[0], replace(loops[1], sample_rate_hz=10_000.0)])


def test_weights_follow_without_a_search(data):
    """With lag, spacing and delay known, the linear problem alone is within 1 % of the stroke."""
    layers = Layers(8, 5)
    point = start(data, layers, [1e-4, 0.3, 0.5, 0.0], data.half_period_s)
    errors, _ = error_and_slopes(data, layers, point)
    assert np.max(np.abs(errors)) < 0.01 * data.stroke_um
