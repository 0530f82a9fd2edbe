"""Operators one after another, and the weights that smooth."""

import numpy as np
import pytest

from hilctl.models.cascade import Chain, between, delayed, smoothing_weights
from hilctl.models.creep import CreepModel
from hilctl.models.plays import PpiModel

PLAYS = PpiModel(direct=1.0, weights=(0.5, 0.25), thresholds=(0.25, 0.5))
SIGNAL = np.array([1.0, 2.0, 4.0, 3.0, -1.0, 0.5])


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_delayed_holds_back_that_many_samples(samples):
    """Before the first has come through, it stands where the signal began."""
    expected = [SIGNAL[max(k - samples, 0)] for k in range(SIGNAL.size)]
    assert delayed(samples).process(SIGNAL).tolist() == expected


def test_between_goes_that_part_of_the_way():
    assert between(0.25).process(SIGNAL).tolist() == [1.0, 1.25, 2.5, 3.75, 2.0, -0.625]
    assert between(1.0).process(SIGNAL).tolist() == SIGNAL.tolist()


def test_a_chain_is_its_operators_one_after_another():
    """Between the offsets, and with no preview where none is given."""
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
    """One array, in their order, that they go on from; at rest it is theirs at rest."""
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
    """Its memory is then a part of that one's, as those of its operators are."""
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
    """Operators that have seen a signal are taken as they are, and reset to that."""
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
    """A central difference a sample, and a second one."""
    weights, _ = smoothing_weights(0.0, 2.0, 5.0)
    np.testing.assert_allclose(weights, [5.0 - 1.0, 1.0 - 10.0, 5.0 + 1.0])


def test_weights_add_up_and_follow_slope_and_bend():
    """Constant, ramp and parabola come out as their derivatives say, whatever the width."""
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
