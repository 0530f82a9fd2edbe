"""Minor loops within an average cycle."""

import numpy as np
import pytest

from hilctl.studies.multi_run.minor_loops import minor_loops

TURN = np.arange(1000) / 1000.0 * 2.0 * np.pi


def complex_harmonic(first, third):
    return first * np.sin(TURN) + third * np.sin(3.0 * TURN)


@pytest.mark.parametrize(
    ("first", "third", "span"), [(4.0, 3.0, 4.2), (5.0, 2.0, 1.96), (3.0, 4.0, 6.6)]
)
def test_one_at_either_end_of_a_complex_harmonic(first, third, span):
    u = complex_harmonic(first, third)
    low, high = minor_loops(u, 2.0 * u)
    assert low.middle == pytest.approx(-high.middle, abs=0.02)
    for loop in (low, high):
        assert loop.span == pytest.approx(span, rel=0.02)
        assert loop.peak_to_peak_um == pytest.approx(2.0 * loop.span, rel=0.01)
        assert loop.peak_hysteresis_percent < 1e-6


def test_the_distance_of_their_branches_is_theirs():
    """A play of 0.5 parallel to a line: 0.5 um of the minor loop's motion."""
    u = complex_harmonic(4.0, 3.0)
    y, held = np.empty(u.size), 0.0
    for _ in range(2):
        for k, value in enumerate(u):
            held = min(max(held, value - 0.25), value + 0.25)
            y[k] = value + held
    low, high = minor_loops(u, y)
    for loop in (low, high):
        assert loop.peak_to_peak_um == pytest.approx(2.0 * loop.span - 0.5, rel=0.02)
        gap_um = loop.peak_hysteresis_percent / 100.0 * loop.peak_to_peak_um
        assert gap_um == pytest.approx(0.5, rel=0.05)


def test_a_sine_has_none():
    assert minor_loops(np.sin(TURN), np.cos(TURN)) == ()
    assert minor_loops(np.zeros(100), np.zeros(100)) == ()
    noisy = np.sin(TURN) + 1e-3 * np.random.default_rng(1).standard_normal(TURN.size)
    assert minor_loops(noisy, noisy) == ()
