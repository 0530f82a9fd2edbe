"""Reducing long signals for a plot."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilctl.lab.pages import plot_style


def test_short_signal_is_left_alone() -> None:
    t = np.arange(100.0)
    shown_t, shown = plot_style.min_max(t, t**2, 100)
    np.testing.assert_array_equal(shown_t, t)
    np.testing.assert_array_equal(shown, t**2)


@pytest.mark.parametrize("size", [4001, 12_345, 1_000_000])
def test_every_spike_stays_visible(size: int) -> None:
    values = np.zeros(size)
    places = np.linspace(0, size - 1, 7).astype(int)
    values[places] = [5.0, -6.0, 7.0, -8.0, 9.0, -10.0, 11.0]
    t, shown = plot_style.min_max(np.arange(size) * 1.0, values)
    assert shown.size <= plot_style.MAX_POINTS
    assert set(values[places]) <= set(shown)
    assert np.all(np.diff(t) >= 0.0)
    assert np.abs(t[np.abs(shown) > 0] - places).max() <= size / plot_style.MAX_POINTS + 1.0


def test_line_breaks_where_nothing_is_finite() -> None:
    values = np.ones(10_000)
    values[50] = np.nan
    values[5000:6000] = np.nan
    _, shown = plot_style.min_max(np.arange(10_000.0), values, 1000)
    assert np.count_nonzero(np.isnan(shown)) == pytest.approx(100, abs=2)
    assert not np.isnan(shown[:100]).any()


@pytest.mark.parametrize("period", [200.0, 333.3, 1999.0])
def test_band_of_a_steady_wave_has_straight_edges(period: float) -> None:
    index = np.arange(1_000_000, dtype=np.int64)
    middle, low, high = plot_style.band(index, np.sin(2.0 * np.pi * index / period), period)
    assert middle.size <= 600
    assert np.diff(middle).min() >= period * 0.999
    np.testing.assert_allclose(high, 1.0, atol=1e-3)
    np.testing.assert_allclose(low, -1.0, atol=1e-3)


def test_band_follows_the_index_across_gaps() -> None:
    index = np.concatenate((np.arange(10_000), np.arange(90_000, 100_000))).astype(np.int64)
    middle, low, high = plot_style.band(index, np.where(index < 50_000, 1.0, 2.0), 1000.0)
    assert np.all(high[middle < 10_000] == 1.0)
    assert np.all(low[middle > 90_000] == 2.0)
    assert not ((middle > 11_000) & (middle < 89_000)).any()


def test_many_narrow_cycles_are_a_band() -> None:
    assert plot_style.shown_as_band(100_000, 200.0, 100_000)
    assert not plot_style.shown_as_band(100_000, 2000.0, 100_000)
    assert not plot_style.shown_as_band(700, 200.0, 100_000)
    assert not plot_style.shown_as_band(100_000, 0.0, 100_000)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.13, 0.36, [0.15, 0.2, 0.25, 0.3, 0.35]),
        (0.9, 80.0, [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]),
        (0.9, 2000.0, [1.0, 10.0, 100.0, 1000.0]),
    ],
)
def test_a_logarithmic_axis_has_few_ticks(low: float, high: float, expected: list[float]) -> None:
    axes = Figure().subplots()
    axes.set(yscale="log", ylim=(low, high))
    plot_style.plain_numbers(axes)
    shown = [tick for tick in axes.get_yticks() if low <= tick <= high]
    np.testing.assert_allclose(shown, expected)
