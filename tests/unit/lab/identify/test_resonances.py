"""Further modes, from what a model with one mode leaves: found where they are, and only there."""

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.resonances import _stands, further_modes, without_modes
from hilctl.models.linear_stages import FirstMode, FurtherMode

RATE_HZ = 20e3
FIRST = FirstMode(natural_hz=2300.0, damping_ratio=0.12)
LOW = FurtherMode(
    natural_hz=600.0, damping_ratio=0.03, antiresonance_hz=630.0, antiresonance_damping_ratio=0.032
)
HIGH = FurtherMode(
    natural_hz=1100.0, damping_ratio=0.02, antiresonance_hz=1050.0, antiresonance_damping_ratio=0.02
)


def plan_um(seconds=4.0, seed=5):
    """Random motion whose speed changes at once, as that of plays does where they turn."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-40.0, 40.0, round(150 * seconds))
    at = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.interp(at, np.arange(corners.size) / 150.0, corners)


def measured(*modes, noise_um=0.03, bend_um=0.0):
    """Return a record, and what a model without modes gives for it."""
    x_um = FIRST.forward(RATE_HZ).process(plan_um())
    y_um = x_um + bend_um * np.sin(0.2 * x_um)  # what no linear part explains
    for mode in modes:
        y_um = mode.forward(RATE_HZ).process(y_um)
    y_um = y_um + noise_um * np.random.default_rng(1).standard_normal(x_um.size)
    return History("h", np.arange(x_um.size) * 1e-5, y_um, RATE_HZ), x_um


def near(found, true):
    got, wanted = found.model_dump(), true.model_dump()
    for name, rel in (("natural_hz", 0.01), ("antiresonance_hz", 0.01), ("damping_ratio", 0.3)):
        assert got[name] == pytest.approx(wanted[name], rel=rel), name


@pytest.mark.parametrize("true", [LOW, HIGH])
@pytest.mark.parametrize("bend_um", [0.0, 0.1])
def test_a_mode_is_found_beside_noise_and_what_is_not_linear(true, bend_um):
    record, x_um = measured(true, bend_um=bend_um)
    (found,) = further_modes([record], [x_um], (), FIRST.natural_hz)
    near(found, true)


def test_modes_come_one_after_the_other_and_the_first_gets_better():
    record, x_um = measured(LOW, HIGH, noise_um=0.01)
    one = further_modes([record], [x_um], (), FIRST.natural_hz)
    assert len(one) == 1
    modelled_um = one[0].forward(RATE_HZ).process(x_um)
    both = further_modes([record], [modelled_um], one, FIRST.natural_hz)
    for found, true in zip(sorted(both, key=lambda m: m.natural_hz), (LOW, HIGH), strict=True):
        near(found, true)


def test_none_is_found_where_there_is_none():
    record, x_um = measured(bend_um=0.3)
    assert further_modes([record], [x_um], (), FIRST.natural_hz) is None


def test_what_is_known_is_not_found_again():
    record, x_um = measured(LOW)
    modelled_um = LOW.forward(RATE_HZ).process(x_um)
    assert further_modes([record], [modelled_um], (LOW,), FIRST.natural_hz) is None


def test_a_first_mode_that_is_not_quite_right_is_no_further_one():
    record, _ = measured()
    off = FirstMode(natural_hz=1900.0, damping_ratio=0.2).forward(RATE_HZ)
    assert further_modes([record], [off.process(plan_um())], (), 1900.0) is None


def test_short_records_say_nothing():
    record, x_um = measured(LOW)
    short = History("h", record.command[:9000], record.displacement_um[:9000], RATE_HZ)
    assert further_modes([short], [x_um[:9000]], (), FIRST.natural_hz) is None


def test_what_is_not_judged_does_not_count():
    record, x_um = measured(LOW)
    late = History("h", record.command, record.displacement_um, RATE_HZ, ignore=20_000)
    (found,) = further_modes([late], [x_um[20_000:]], (), FIRST.natural_hz)
    near(found, LOW)


def test_modes_are_taken_off_histories_and_left_in_loops():
    record, x_um = measured(LOW, noise_um=0.0)
    time = np.arange(64) / 64
    loop = SteadyLoop("l", np.sin(2 * np.pi * time), np.cos(2 * np.pi * time), 10.0, RATE_HZ)
    bare, same = without_modes([record, loop], [LOW])
    np.testing.assert_allclose(bare.displacement_um, x_um, rtol=0.0, atol=1e-8)
    assert same is loop


def late(x_um, samples):
    return np.concatenate((np.full(samples, x_um[0]), x_um[:-samples]))


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_what_the_next_fit_finds_by_itself_is_no_mode(gain):
    record, x_um = measured(noise_um=0.3)
    assert further_modes([record], [gain * late(x_um, 1)], (), FIRST.natural_hz) is None


@pytest.mark.parametrize("gain", [0.996, 1.004])
def test_a_mode_is_found_beside_a_gain(gain):
    record, x_um = measured(LOW)
    (found,) = further_modes([record], [gain * x_um], (), FIRST.natural_hz)
    near(found, LOW)


@pytest.mark.parametrize(("modes", "rate_hz", "stands"), [
    ((LOW,), RATE_HZ, True),
    ((LOW, HIGH), RATE_HZ, True),
    ((HIGH, LOW.model_copy(update={"natural_hz": 1000.0})), RATE_HZ, False),  # one, cut in two
    ((LOW.model_copy(update={"natural_hz": 2200.0}),), RATE_HZ, False),  # the first one
    ((LOW.model_copy(update={"antiresonance_hz": 2500.0}),), RATE_HZ, False),
    ((LOW.model_copy(update={"antiresonance_hz": 100.0}),), 1000.0, False),  # cannot be undone
    ((LOW.model_copy(update={"antiresonance_damping_ratio": 0.2999}),), RATE_HZ, False),
])  # fmt: skip
def test_modes_stand_where_they_are_apart_and_can_be_undone(modes, rate_hz, stands):
    assert _stands(modes, FIRST.natural_hz, rate_hz) is stands


def test_a_model_that_leaves_nothing_has_all_modes():
    record, _ = measured(noise_um=0.0)
    assert further_modes([record], [record.displacement_um], (), FIRST.natural_hz) is None
