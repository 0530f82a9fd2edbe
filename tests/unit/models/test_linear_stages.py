"""Operators one after another, and the weights that smooth."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.kernels.dynamics import unmode_block
from hilctl.models.linear_stages import (
    Chain,
    CreepModel,
    FirstMode,
    FurtherMode,
    _decay,
    between,
    delayed,
    smoothing_weights,
)
from hilctl.models.plays import PpiModel

PLAYS = PpiModel(direct=1.0, weights=(0.5, 0.25), thresholds=(0.25, 0.5))
SIGNAL = np.array([1.0, 2.0, 4.0, 3.0, -1.0, 0.5])


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_delayed_holds_back_that_many_samples(samples):
    expected = [SIGNAL[max(k - samples, 0)] for k in range(SIGNAL.size)]
    assert delayed(samples).process(SIGNAL).tolist() == expected


def test_between_goes_that_part_of_the_way():
    assert between(0.25).process(SIGNAL).tolist() == [1.0, 1.25, 2.5, 3.75, 2.0, -0.625]
    assert between(1.0).process(SIGNAL).tolist() == SIGNAL.tolist()


def test_a_chain_is_its_operators_one_after_another():
    chain = Chain([delayed(2), PLAYS.forward(1.0), between(0.5)], input_offset=3.0,
                  output_offset=-0.5)  # fmt: skip
    by_hand = SIGNAL + 3.0
    for stage in (delayed(2), PLAYS.forward(1.0), between(0.5)):
        by_hand = stage.process(by_hand)
    assert chain.process(SIGNAL).tolist() == (by_hand - 0.5).tolist()
    assert chain.preview == 0
    assert Chain([delayed(2)]).process(SIGNAL).tolist() == delayed(2).process(SIGNAL).tolist()
    assert Chain([delayed(1)], preview=4).preview == 4


def test_a_chain_s_memory_is_that_of_its_operators():
    stages = [delayed(2), PLAYS.forward(1.0), between(0.5)]
    rest = np.concatenate([stage.state() for stage in stages])
    chain = Chain(stages)
    np.testing.assert_array_equal(chain.state(), rest)
    chain.process(SIGNAL[:3])
    np.testing.assert_array_equal(
        chain.state(), np.concatenate([stage.state() for stage in stages])
    )
    left = chain.state()
    then = chain.process(SIGNAL[3:])
    chain.restore(left)
    np.testing.assert_array_equal(chain.process(SIGNAL[3:]), then)
    chain.reset()
    np.testing.assert_array_equal(chain.state(), rest)


def test_a_chain_may_be_part_of_another():
    inner = Chain([delayed(2), PLAYS.forward(1.0)])
    outer = Chain([between(0.5), inner])
    outer.process(SIGNAL)
    memory = outer.state()
    assert inner.state().tolist() == memory[memory.size - inner.state().size :].tolist()
    then = outer.process(SIGNAL)
    outer.restore(memory)
    inner.reset()
    assert outer.state().tolist() != memory.tolist()
    outer.restore(memory)
    assert outer.process(SIGNAL).tolist() == then.tolist()


def test_a_chain_begins_where_its_operators_stood():
    moved = PLAYS.forward(1.0)
    moved.process(SIGNAL)
    left = moved.state()
    chain = Chain([moved])
    assert chain.state().tolist() == left.tolist()
    chain.process(SIGNAL)
    chain.reset()
    assert chain.state().tolist() == left.tolist()


def test_what_creeps_in_a_chain_goes_on_while_it_stands():
    creep = CreepModel(time_constants_s=(0.01, 0.3), shares=(0.02, 0.04))
    alone, within = creep.forward(1000.0), creep.forward(1000.0)
    chain = Chain([between(1.0), within])
    for each in (alone, chain):
        each.process(SIGNAL)
    before = chain.state()
    for each in (alone, chain):
        each.stand(0.1)
    assert (chain.state() != before).any()
    np.testing.assert_array_equal(within.state(), alone.state())


@pytest.mark.parametrize(("width", "ahead"), [(0.0, 1), (0.6, 1), (0.9, 3), (4.0, 13), (1e6, 127)])
def test_smoothing_reaches_as_far_as_four_boxes(width, ahead):
    """Of round(sqrt(1 + 3 s^2)) samples each, at most 64."""
    weights, m = smoothing_weights(width)
    assert (m, weights.size) == (ahead, 2 * ahead + 1)


@pytest.mark.parametrize("angle", [0.05, 0.1])
def test_smoothing_passes_slow_signals(angle):
    """1 - (w s)^4 / 8 at an angular frequency w: 0.3 % less at a tenth of a radian for s = 4."""
    weights, m = smoothing_weights(4.0)
    k = np.arange(-m, m + 1)
    assert 1.0 - weights @ np.cos(angle * k) == pytest.approx((4.0 * angle) ** 4 / 8.0, rel=0.15)
    assert weights @ np.sin(angle * k) == pytest.approx(0.0, abs=1e-15)


def test_plain_differences_without_a_width():
    weights, _ = smoothing_weights(0.0, 2.0, 5.0)
    np.testing.assert_allclose(weights, [5.0 - 1.0, 1.0 - 10.0, 5.0 + 1.0])


def test_weights_add_up_and_follow_slope_and_bend():
    k = np.arange(400.0)
    for width in (0.0, 0.4, 3.6, 30.0, 1e6):
        weights, m = smoothing_weights(width, 2.0, 5.0)
        assert weights.size == 2 * m + 1 <= 255
        for y, expected in (
            (np.ones(400), np.ones(400)),
            (k, k + 2.0),
            (k**2, k**2 + 2.0 * 2.0 * k + 5.0 * 2.0),
        ):
            out = np.convolve(y, weights[::-1], "valid")
            np.testing.assert_allclose(out, expected[m : 400 - m], rtol=1e-10)


RATE_HZ = 1000.0
CREEP = CreepModel(time_constants_s=(0.05, 2.0), shares=(0.02, 0.04))


def signal(n=4000):
    return np.cumsum(np.random.default_rng(4).standard_normal(n))


def test_a_displacement_that_stays_creeps_on_by_each_share():
    x_um = np.concatenate(([0.0], np.full(20_000, 10.0)))
    time_s = np.arange(x_um.size - 1) / RATE_HZ
    crept = CREEP.forward(RATE_HZ).process(x_um) - x_um
    wanted = 0.2 * -np.expm1(-time_s / 0.05) + 0.4 * -np.expm1(-time_s / 2.0)
    np.testing.assert_allclose(crept[1:], wanted, rtol=0.0, atol=1e-12)


BENT = CREEP.model_copy(update={"bend_per_um": 0.02})


@pytest.mark.parametrize("creep", [CREEP, BENT])
def test_inverse_undoes_creep_exactly(creep):
    x_um = signal()
    y_um = creep.forward(RATE_HZ).process(x_um)
    assert np.abs(y_um - x_um).max() > 0.01 * np.ptp(x_um)
    np.testing.assert_allclose(creep.inverse(RATE_HZ).process(y_um), x_um, rtol=0.0, atol=1e-9)


def test_with_a_bend_the_root_of_the_displacement_creeps():
    """From x = p + b p^2 with b p = 1 to q + b q^2, for q = 1.06 p."""
    crept_um = BENT.forward(RATE_HZ).process(np.full(30_000, 100.0))[-1]
    assert crept_um == pytest.approx(50.0 * 1.06 + 0.02 * (50.0 * 1.06) ** 2, rel=1e-6)


@pytest.mark.parametrize("creep", [CREEP, BENT])
def test_only_what_is_away_from_rest_creeps(creep):
    still = np.full(3000, -7.5)
    for operator in (creep.forward(RATE_HZ, rest_um=-7.5), creep.inverse(RATE_HZ, rest_um=-7.5)):
        np.testing.assert_array_equal(operator.process(still), still)


def test_a_value_that_is_none_is_not_gone_on_from():
    y_um = np.full(100, 5.0)
    y_um[40] = np.nan
    came = CREEP.inverse(RATE_HZ).process(y_um)
    assert np.isnan(came[40])
    assert np.isfinite(np.delete(came, 40)).all()


@pytest.mark.parametrize(("times_s", "shares", "message"), [
    ((1.0, 0.5), (0.1, 0.1), "T must rise from 0"),
    ((1.0,), (0.1, 0.1), "shares must have one value per time constant: 2 for 1"),
    ((), (), "at least 1 item"),
])  # fmt: skip
def test_conditions_are_named(times_s, shares, message):
    with pytest.raises(ValidationError, match=message):
        CreepModel(time_constants_s=times_s, shares=shares)


FAST_HZ = 50e3
MODE = {
    "natural_hz": 900.0,
    "damping_ratio": 0.04,
    "antiresonance_hz": 760.0,
    "antiresonance_damping_ratio": 0.02,
}


def answer(operator, frequency_hz):
    """Return the steady answer to a sine, as a complex gain."""
    time_s = np.arange(round(0.4 * FAST_HZ)) / FAST_HZ
    out = operator.process(np.sin(2.0 * math.pi * frequency_hz * time_s))
    steady = slice(round(0.3 * FAST_HZ), None)
    turning = np.exp(-2j * math.pi * frequency_hz * time_s[steady])
    return 2j * np.mean(out[steady] * turning)


def second_order(frequency_hz, natural_hz, damping_ratio):
    part = 1j * frequency_hz / natural_hz
    return 1.0 / (1.0 + 2.0 * damping_ratio * part + part**2)


@pytest.mark.parametrize("frequency_hz", [100.0, 760.0, 900.0, 1500.0])
def test_a_mode_answers_sines_as_its_response_says(frequency_hz):
    mode = FurtherMode(**MODE)
    wanted = mode.response(np.array([frequency_hz]))[0]
    up = second_order(frequency_hz, 900.0, 0.04) / second_order(frequency_hz, 760.0, 0.02)
    assert wanted == pytest.approx(up)
    assert answer(mode.forward(FAST_HZ), frequency_hz) == pytest.approx(wanted, rel=2e-3, abs=3e-3)


def test_modes_side_by_side_are_the_first_and_a_pair():
    """(1 - c) G_1 + c G_2 with equal damping of both, over frequencies on all sides of them."""
    share, first, second = 0.1, (2300.0, 0.12), (700.0, 0.03)
    w, f = np.array([first[0], second[0]]), np.array([50.0, 300.0, 690.0, 1200.0, 3000.0])
    bend = (1.0 - share) / w[1] ** 2 + share / w[0] ** 2
    slope = 2.0 * ((1.0 - share) * second[1] / w[1] + share * first[1] / w[0])
    hz = 1.0 / math.sqrt(bend)
    mode = FurtherMode(natural_hz=w[1], damping_ratio=second[1], antiresonance_hz=hz,
                antiresonance_damping_ratio=0.5 * slope * hz)  # fmt: skip
    both = (1.0 - share) * second_order(f, *first) + share * second_order(f, *second)
    np.testing.assert_allclose(second_order(f, *first) * mode.response(f), both, rtol=1e-12)


def test_the_inverse_of_a_mode_is_exact_and_dies_away():
    x = np.cumsum(np.random.default_rng(3).standard_normal(20_000))
    mode = FurtherMode(**MODE)
    y = mode.forward(FAST_HZ).process(x)
    np.testing.assert_allclose(mode.inverse(FAST_HZ).process(y), x, rtol=0.0, atol=1e-8)
    step = mode.inverse(FAST_HZ).process(np.concatenate(([0.0], np.ones(round(0.5 * FAST_HZ)))))
    assert step[-1] == pytest.approx(1.0, abs=1e-9)


def test_a_mode_beyond_what_samples_show_is_refused_in_words():
    mode = FurtherMode(**(MODE | {"natural_hz": 8000.0, "antiresonance_hz": 700.0}))
    with pytest.raises(ModelError, match=r"8000 Hz .* 5000 samples"):
        mode.inverse(5000.0)


@pytest.mark.parametrize("change", [
    {},
    {"natural_hz": 2500.0, "damping_ratio": 0.3},
    {"antiresonance_hz": 1500.0, "antiresonance_damping_ratio": 0.2},
    {"natural_hz": 8000.0, "antiresonance_hz": 700.0},
])  # fmt: skip
def test_what_is_known_of_the_inverse_s_decay_is_what_it_does(change):
    parameters = FurtherMode(**(MODE | change))._parameters(5000.0)
    memory, sizes = np.array([0.3, -0.7, 1.0]), []
    for _ in range(2):
        unmode_block(np.zeros(60), parameters, memory, np.empty(60))
        sizes.append(float(np.abs(memory).max()))
    # Over a whole number of turns it would be exact.
    rate = (sizes[1] / sizes[0]) ** (1.0 / 60.0)
    assert rate == pytest.approx(_decay(parameters), rel=0.02)


def test_a_mode_that_would_come_to_grow_slowly_is_refused_too():
    mode = FurtherMode(
        natural_hz=1500.0, damping_ratio=0.01, antiresonance_hz=100.0,
        antiresonance_damping_ratio=0.01,
    )  # fmt: skip
    assert 1.0 < _decay(mode._parameters(2000.0)) < 2.0
    with pytest.raises(ModelError, match="no inverse"):
        mode.inverse(2000.0)


@pytest.mark.parametrize("frequency_hz", [100.0, 2300.0])
def test_a_structure_answers_sines_as_a_second_order_does(frequency_hz):
    structure = FirstMode(natural_hz=2300.0, damping_ratio=0.12)
    wanted = second_order(frequency_hz, 2300.0, 0.12)
    came = answer(structure.forward(FAST_HZ), frequency_hz)
    assert came == pytest.approx(wanted, rel=1e-2, abs=3e-3)
    assert structure.radian_s == pytest.approx(1.0 / (2.0 * math.pi * 2300.0))


def test_a_structure_that_does_not_move_is_refused():
    with pytest.raises(ModelError, match="natural_hz is too low for a step of 2e-05 s"):
        FirstMode(natural_hz=1e-12, damping_ratio=0.1).motion(FAST_HZ)
