"""Gain and offset of a running reference."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.events import INVERSE, TUNED
from hilctl.base.samples import Flag
from hilctl.loop.tuning import LinearBypass, ReferenceTuner, Tuning, tune


def tuned(tuner, values, out):
    """Fill ``out`` as the loop does."""
    factors = tuner.advance(values.size)
    if factors is None:
        out[:] = values
    else:
        tune(factors, values, out)


def run(tuner, reference, block, moves):
    """Tune a reference in blocks; ``moves`` begin at sample indices."""
    out = np.empty_like(reference)
    for start in range(0, reference.size, block):
        if start in moves:
            tuner.move(moves[start])
        part = slice(start, start + block)
        tuned(tuner, reference[part], out[part])
    return out


def test_untuned_reference_is_unchanged_bit_for_bit():
    reference = np.random.default_rng(1).normal(size=100)
    assert run(ReferenceTuner(), reference, 7, {}).tobytes() == reference.tobytes()


def test_change_is_a_linear_ramp_to_the_exact_value():
    out = run(ReferenceTuner(), np.ones(100), 10, {20: Tuning(0.3, 0.4, 30)})
    assert (out[:20] == 1.0).all()
    assert np.diff(out[19:50]) == pytest.approx(np.full(30, -0.3 / 30))
    assert (out[50:] == 0.3 * 1.0 + 0.4).all()


def test_second_change_begins_at_the_present_value():
    out = run(
        ReferenceTuner(), np.ones(100), 5, {10: Tuning(0.0, 0.0, 50), 30: Tuning(1.0, 0.0, 20)}
    )
    assert np.abs(np.diff(out)).max() == pytest.approx(0.4 / 20)
    assert (out[50:] == 1.0).all()


@given(st.integers(1, 40), st.integers(0, 3), st.integers(1, 60))
def test_block_cuts_make_no_difference(block, start, samples):
    reference = np.sin(np.arange(240) / 5.0)
    begin = start * 40
    whole, cut = ReferenceTuner(), ReferenceTuner()
    expected = run(whole, reference, 40, {begin: Tuning(0.5, 1.0, samples)})
    out = np.empty_like(reference)
    at = 0
    while at < reference.size:
        stop = min(at + block, reference.size, begin if at < begin else reference.size)
        if at == begin:
            cut.move(Tuning(0.5, 1.0, samples))
        tuned(cut, reference[at:stop], out[at:stop])
        at = stop
    assert out == pytest.approx(expected, abs=1e-15)


def test_two_arrays_are_moved_alike():
    tuner, a, b = ReferenceTuner(), np.empty(10), np.empty(10)
    tuner.move(Tuning(2.0, 1.0, 10))
    factors = tuner.advance(10)
    tune(factors, np.ones(10), a)
    tune(factors, np.zeros(10), b)
    assert a - b == pytest.approx(1.0 + np.arange(1, 11) / 10)
    assert tuner.advance(1) == (2.0, 1.0, 1.0)


FADE = Tuning(1.0, 0.0, 30, 0.0, LinearBypass(0.5, -1.0))
BACK = replace(FADE, samples=20, inverse_share=1.0)


def faded(tuner, reference, wanted, block, moves):
    """Fade commands in blocks; return them, and the flagged samples."""
    out, flags = wanted.copy(), np.zeros(wanted.size, dtype=np.uint32)
    for start in range(0, wanted.size, block):
        if start in moves:
            tuner.move(moves[start])
        part = slice(start, start + block)
        if (factors := tuner.advance(out[part].size)) is not None:
            tuner.fade(factors, reference[part], out[part], flags[part])
    return out, flags == Flag.INVERSE_OUT


def test_bypass_and_return_are_exact():
    reference, wanted = np.random.default_rng(1).normal(size=(2, 200))
    wanted[150] = -0.0
    out, flagged = faded(ReferenceTuner(), reference, wanted, 10, {40: FADE, 100: BACK})
    straight = 0.5 * reference - 1.0
    share = np.interp(np.arange(200), [39, 69, 99, 119], [1.0, 0.0, 0.0, 1.0])
    assert out == pytest.approx(share * wanted + (1.0 - share) * straight)
    assert (out[69:100] == straight[69:100]).all()
    assert flagged.tolist() == (share < 1.0).tolist()
    assert out[~flagged].tobytes() == wanted[~flagged].tobytes()


@given(st.sampled_from([1, 2, 5, 10, 20]), st.integers(0, 6))
def test_block_cuts_give_the_same_bits_of_a_fade(block, overtaken):
    reference, wanted = np.random.default_rng(2).normal(size=(2, 200))
    moves = {40: FADE, 40 + 20 * overtaken: BACK} if overtaken else {40: FADE}
    whole, _ = faded(ReferenceTuner(), reference, wanted, 20, moves)
    cut, _ = faded(ReferenceTuner(), reference, wanted, block, moves)
    assert cut.tobytes() == whole.tobytes()


def test_events_name_what_moves_and_no_more():
    tuner = ReferenceTuner()
    (event,) = tuner.events(FADE, 40)
    assert (event.sample, event.code, event.text) == (40, INVERSE, "inverse out, over 30 samples")
    assert event.values == {"share": 0.0, "samples": 30.0, "slope": 0.5, "at_zero": -1.0}
    tuner.move(FADE)
    tuner.pass_over(30)
    both = Tuning(0.5, 0.0, 20)
    assert [each.code for each in tuner.events(both, 90)] == [TUNED, INVERSE]
    assert [each.code for each in tuner.events(replace(FADE, gain=0.5), 90)] == [TUNED]
    assert [each.code for each in ReferenceTuner().events(BACK, 0)] == [TUNED]
