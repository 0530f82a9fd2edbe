"""Curves in braille: as large as is asked for, and no spike is lost."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.cli.braille import BrailleCurve, envelope, plot, round_ticks


@pytest.mark.parametrize(("width", "height"), [(47, 15), (35, 15), (24, 6)])
@pytest.mark.parametrize("curves", [0, 2])
def test_a_plot_has_the_size_that_is_asked_for(width, height, curves):
    """With or without curves, so that it can stand beside another."""
    x = np.linspace(0.0, 20.0, 300)
    made = [BrailleCurve(x, 41.3 * np.sin(x + k), "blue") for k in range(curves)]
    lines = plot(made, width, height, "newest cycles", coloured=False)
    assert [len(each) for each in lines] == [width] * height
    dots = sum(0x2800 < ord(each) < 0x2900 for each in "".join(lines))
    assert bool(dots) == bool(curves)


def test_colours_come_only_where_they_are_asked_for():
    x = np.linspace(0.0, 1.0, 50)
    curves = [BrailleCurve(x, x, "blue"), BrailleCurve(x, 1.0 - x, "orange")]
    assert "\x1b" not in "".join(plot(curves, 40, 10, "", coloured=False))
    assert "\x1b[38;5;" in "".join(plot(curves, 40, 10, "", coloured=True))


def test_what_is_not_finite_is_left_out():
    x = np.arange(10.0)
    y = np.where(x < 5.0, x, np.nan)
    assert any(
        "4" in each for each in plot([BrailleCurve(x, y, "blue")], 40, 12, "", coloured=False)
    )
    nothing = [BrailleCurve(x, np.full(10, np.nan), "blue")]
    assert plot(nothing, 40, 12, "", coloured=False) == plot([], 40, 12, "", coloured=False)


@given(st.integers(0, 599), st.integers(1, 160))
def test_a_spike_of_one_bucket_is_in_the_envelope(at, columns):
    low, high = np.zeros(600), np.zeros(600)
    high[at], low[(at * 7) % 600] = 9.0, -7.0
    x, y = envelope(np.arange(600.0), low, high, columns)
    assert (y.min(), y.max()) == (-7.0, 9.0)
    assert x.size == y.size <= 2 * columns
    assert (np.diff(x) >= 0.0).all()


def test_an_empty_envelope_has_no_points():
    nothing = np.full(5, np.nan)
    assert all(each.size == 0 for each in envelope(np.arange(5.0), nothing, nothing, 10))


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(1, 6))
def test_ticks_are_round_and_span_the_values(low, span, most):
    ticks = round_ticks(np.array((low, low + span)), most)
    assert ticks[0] <= low + 1e-9 * max(abs(low), span)
    assert ticks[-1] >= low + span - 1e-9 * max(abs(low), span)
    assert 2 <= ticks.size <= 2 * most + 3


def test_one_value_has_a_scale_too():
    assert round_ticks(np.array((3.0,)), 4).size >= 2
