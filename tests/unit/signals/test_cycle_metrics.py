"""Folding, loop figures and noise, held against loops and noise whose figures are known."""

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.models.plays import PpiModel
from hilctl.signals import cycle_metrics

PERIODS = [50_000.0, 200.0, 1000.0 / 3.0, 20.0, 1234.567]
NOISE_UM = 0.03553


def triangle(amplitude: float, period: int, cycles: int = 1) -> F64:
    """Return a triangle that starts at 0 and rises."""
    phase = np.arange(period * cycles) / period
    return amplitude * (1.0 - 4.0 * np.abs((phase + 0.25) % 1.0 - 0.5))


def steady_play(loop_input: F64, direct: float, weight: float, threshold: float) -> F64:
    """Return the second of two cycles of a_0 v + a_1 F_r[v]."""
    model = PpiModel(direct=direct, weights=(weight,), thresholds=(threshold,))
    twice = np.concatenate((loop_input, loop_input))
    return model.forward(1.0).process(twice)[loop_input.size :]


def crossing_gap(u: F64, y: F64, level: float) -> float:
    """Return the largest rising-to-falling difference at one input, branch by branch."""
    rising, falling = [], []
    for k in range(u.size):
        u_0, u_1 = u[k], u[(k + 1) % u.size]
        if min(u_0, u_1) <= level <= max(u_0, u_1) and u_0 != u_1:
            y_0, y_1 = y[k], y[(k + 1) % u.size]
            here = y_0 + (y_1 - y_0) * (level - u_0) / (u_1 - u_0)
            (rising if u_1 > u_0 else falling).append(here)
    pairs = [abs(a - b) for a in rising for b in falling]
    return max(pairs, default=0.0)


class TestFold:
    @pytest.mark.parametrize("period", PERIODS)
    def test_average_of_a_repeating_signal_lies_on_its_cycle(self, period: float) -> None:
        index = np.arange(int(period * 6), dtype=np.int64)
        signal = np.sin(2.0 * np.pi * index / period)
        folded = cycle_metrics.fold(index, period, [signal])
        expected = np.sin(2.0 * np.pi * folded.phase)
        bins = folded.phase.size
        assert folded.whole
        assert bins == min(1000, int(period))
        # A bin's mean of a curve differs from the curve at its mean phase by f'' w^2 / 8 at most.
        assert np.abs(folded.signals[0] - expected).max() <= (2.0 * np.pi / bins) ** 2 / 8 + 1e-12

    def test_whole_period_keeps_each_phase_by_itself(self) -> None:
        for period in (200, 333, 777, 999):
            index = np.arange(5 * period, dtype=np.int64)
            cycle = np.random.default_rng(period).normal(size=period)
            folded = cycle_metrics.fold(index, float(period), [np.tile(cycle, 5)])
            np.testing.assert_array_equal(folded.counts, np.full(period, 5))
            np.testing.assert_allclose(folded.signals[0], cycle, rtol=1e-12)

    def test_signals_stay_paired(self) -> None:
        rng = np.random.default_rng(1)
        index = np.sort(rng.choice(20_000, 7_000, replace=False)).astype(np.int64)
        x = np.sin(2.0 * np.pi * index / 333.3) + rng.normal(size=index.size)
        folded = cycle_metrics.fold(index, 333.3, [x, 3.0 * x - 2.0])
        np.testing.assert_allclose(folded.signals[1], 3.0 * folded.signals[0] - 2.0, atol=1e-12)

    def test_samples_that_are_not_finite_are_left_out_of_all_signals(self) -> None:
        index = np.arange(400, dtype=np.int64)
        x, y = np.ones(400), np.full(400, 2.0)
        x[7], y[50] = np.nan, np.inf
        folded = cycle_metrics.fold(index, 100.0, [x, y])
        assert folded.counts.sum() == 398
        assert set(folded.signals[0]) == {1.0}
        assert set(folded.signals[1]) == {2.0}

    def test_empty_bins_are_dropped_and_a_hole_is_reported(self) -> None:
        index = np.arange(1000, dtype=np.int64)
        for lost, whole in ((1, True), (40, True), (60, False), (500, False)):
            kept = index[index % 1000 >= lost]
            folded = cycle_metrics.fold(kept, 1000.0, [kept * 1.0])
            assert folded.phase.size == 1000 - lost
            assert folded.whole is whole

    def test_nothing_finite_folds_to_nothing(self) -> None:
        folded = cycle_metrics.fold(np.arange(100, dtype=np.int64), 50.0, [np.full(100, np.nan)])
        assert folded.phase.size == 0
        assert not folded.whole


class TestPeakHysteresis:
    @pytest.mark.parametrize("lag", [0.01, 0.187, 0.8, -0.3])
    @pytest.mark.parametrize("bins", [200, 333, 1000])
    def test_sine_that_lags_gives_the_sine_of_its_lag(self, lag: float, bins: int) -> None:
        """A sin t against B sin(t - lag): 2 B sin(lag) at input 0, over 2 B."""
        t = 2.0 * np.pi * (np.arange(bins) + 0.3) / bins
        percent = cycle_metrics.peak_hysteresis_percent(
            6.0 * np.sin(t), 41.0 * np.sin(t - lag) + 7.0
        )
        assert percent == pytest.approx(100.0 * abs(np.sin(lag)), rel=2e-4)

    @pytest.mark.parametrize("threshold", [0.5, 1.5, 2.9])
    def test_play_operator_has_its_closed_form(self, threshold: float) -> None:
        """a_0 v + a_1 F_r, amplitude A >= 2 r: gap 2 a_1 r over 2 (a_0 A + a_1 (A - r))."""
        u = triangle(6.0, 1200)
        y = steady_play(u, 1.0, 2.0, threshold)
        expected = 2.0 * threshold / (6.0 + 2.0 * (6.0 - threshold))
        assert cycle_metrics.peak_hysteresis_percent(u, y) == pytest.approx(
            100.0 * expected, rel=1e-12
        )

    def test_play_wider_than_its_input_allows_fills_its_stroke(self) -> None:
        """With r < A < 2 r the branches of a bare play lie a whole stroke apart at input 0."""
        u = triangle(6.0, 1200)
        y = steady_play(u, 1e-9, 1.0, 4.0)
        assert cycle_metrics.peak_hysteresis_percent(u, y) == pytest.approx(100.0, rel=1e-6)

    def test_hysteresis_is_independent_of_direction_and_start(self) -> None:
        u = triangle(6.0, 1200)
        y = steady_play(u, 1.0, 2.0, 1.5)
        expected = cycle_metrics.peak_hysteresis_percent(u, y)
        assert cycle_metrics.peak_hysteresis_percent(u[::-1], y[::-1]) == pytest.approx(expected)
        assert cycle_metrics.peak_hysteresis_percent(-u, -y) == pytest.approx(expected)
        for start in (1, 300, 301, 900, 1199):
            rolled = cycle_metrics.peak_hysteresis_percent(np.roll(u, start), np.roll(y, start))
            assert rolled == pytest.approx(expected)

    def test_nonlinearity_is_no_hysteresis(self) -> None:
        t = 2.0 * np.pi * np.arange(500) / 500
        u, y = np.sin(t), np.sin(t - 0.2)
        plain, bent = (
            cycle_metrics.widest_gap(u, y),
            cycle_metrics.widest_gap(u, y + 3.0 * u - u**3),
        )
        assert plain is not None
        assert bent is not None
        assert bent.height == pytest.approx(plain.height, rel=1e-3)
        assert bent.at_input == pytest.approx(plain.at_input, abs=0.05)

    @pytest.mark.parametrize(("first", "third"), [(4.0, 3.0), (3.0, 4.0)])
    def test_minor_loops_take_in_all_pairs_of_branches(self, first: float, third: float) -> None:
        t = 2.0 * np.pi * np.arange(600) / 600
        u = first * np.sin(t) + third * np.sin(3.0 * t)
        y = steady_play(u, 1.0, 2.0, 1.1) + steady_play(u, 0.5, 1.0, 2.3)
        found = cycle_metrics.widest_gap(u, y)
        levels = np.unique(u)
        expected = max(crossing_gap(u, y, level) for level in (levels[1:] + levels[:-1]) / 2)
        assert found is not None
        assert found.height >= expected - 1e-12
        assert found.height == pytest.approx(expected, rel=0.01)
        assert found.height == pytest.approx(crossing_gap(u, y, found.at_input), rel=1e-9)

    def test_constant_input_belongs_to_its_branch(self) -> None:
        t = 2.0 * np.pi * np.arange(1000) / 1000
        u = np.clip(np.sin(t), -0.8, 0.8)
        y = np.sin(t - 0.2)
        gap = cycle_metrics.widest_gap(u, y)
        assert gap is not None
        assert gap.height == pytest.approx(2.0 * np.sin(0.2), rel=1e-3)

    def test_creep_while_the_input_waits_is_of_that_branch(self) -> None:
        """Rising, the output creeps from 1 to 2 while the input waits at 1; falling it passes 1.5.

        The branches are half apart there; the creep itself is no second branch.
        """
        u = np.array([0.0, 0.5, 1.0, 1.0, 1.0, 1.5, 2.0, 1.5, 1.0, 0.5])
        y = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.0, 2.0, 1.75, 1.5, 0.75])
        gap = cycle_metrics.widest_gap(u, y)
        assert gap is not None
        assert gap.height == pytest.approx(0.5)
        assert gap.at_input == 1.0

    def test_straight_line_has_none(self) -> None:
        u = np.sin(2.0 * np.pi * np.arange(777) / 777)
        assert cycle_metrics.peak_hysteresis_percent(u, 7.0 * u - 3.0) == pytest.approx(
            0.0, abs=1e-10
        )

    def test_meaningless_input_gives_none(self) -> None:
        wave = np.sin(np.arange(10.0))
        assert cycle_metrics.peak_hysteresis_percent(np.ones(10), wave) is None
        assert cycle_metrics.peak_hysteresis_percent(wave, np.ones(10)) is None
        assert cycle_metrics.peak_hysteresis_percent(wave[:3], wave[:3]) is None


class TestLoopArea:
    def test_ellipse(self) -> None:
        """A sin t against B sin(t - lag) encloses pi A B sin(lag), whichever way round."""
        t = 2.0 * np.pi * np.arange(1000) / 1000
        for lag in (0.2, -0.2):
            area = cycle_metrics.loop_area(6.0 * np.sin(t) + 50.0, 41.0 * np.sin(t - lag) - 1e3)
            assert area == pytest.approx(np.pi * 6.0 * 41.0 * np.sin(0.2), rel=1e-4)

    def test_play_operator(self) -> None:
        """A play of threshold r under amplitude A encloses 2 r times 2 (A - r)."""
        u = triangle(6.0, 1200)
        area = cycle_metrics.loop_area(u, steady_play(u, 1.0, 2.0, 1.5))
        assert area == pytest.approx(2.0 * 4.0 * 1.5 * 4.5, rel=1e-12)

    def test_figure_of_eight_cancels(self) -> None:
        t = 2.0 * np.pi * np.arange(1000) / 1000
        assert cycle_metrics.loop_area(np.sin(t), np.sin(2.0 * t)) == pytest.approx(0.0, abs=1e-12)


def test_peak_and_rms_include_the_offset() -> None:
    """An error of 2 + sin has peak 3 and rms sqrt(4 + 1/2)."""
    error = 2.0 + np.sin(2.0 * np.pi * np.arange(1000) / 1000)
    assert cycle_metrics.peak(error) == pytest.approx(3.0)
    assert cycle_metrics.peak(-error) == pytest.approx(3.0)
    assert cycle_metrics.rms(error) == pytest.approx(np.sqrt(4.5))


def test_percent_of_nothing_is_none() -> None:
    assert cycle_metrics.percent(1.0, 0.0) is None
    assert cycle_metrics.percent(1.0, 4.0) == 25.0


@pytest.mark.parametrize("frequency_hz", [1.0, 150.0, 250.0])
def test_finds_the_published_noise_on_a_full_stroke(frequency_hz: float) -> None:
    """35.53 nm on 83 um at 50 kHz reads 35.5 nm within 0.8 %, at 1 Hz as at 250 Hz."""
    index = np.arange(400_000, dtype=np.int64)
    sine = 41.5 * np.sin(2.0 * np.pi * frequency_hz * index / 50_000)
    reading = sine + np.random.default_rng(3).normal(0.0, NOISE_UM, index.size)
    assert cycle_metrics.sensor_noise_um(index, reading) == pytest.approx(NOISE_UM, rel=0.008)


def test_clean_signal_has_next_to_none() -> None:
    """The signal itself does not count: 250 Hz at 50 kHz leaves less than 0.1 nm."""
    index = np.arange(10_000, dtype=np.int64)
    found = cycle_metrics.sensor_noise_um(index, 41.5 * np.sin(2.0 * np.pi * index / 200))
    assert found is not None
    assert found < 1e-4


def test_shortest_period_still_passes_for_smooth() -> None:
    """At 16 samples a period the signal adds less than a tenth to the published noise."""
    index = np.arange(200_000, dtype=np.int64)
    sine = 41.5 * np.sin(2.0 * np.pi * index / cycle_metrics.SHORTEST_PERIOD)
    reading = sine + np.random.default_rng(4).normal(0.0, NOISE_UM, index.size)
    assert cycle_metrics.sensor_noise_um(index, reading) == pytest.approx(NOISE_UM, rel=0.1)


def test_spikes_corners_and_gaps_do_not_count() -> None:
    rng = np.random.default_rng(5)
    index = np.arange(60_000, dtype=np.int64)
    reading = 40.0 * np.abs((index / 1000) % 2.0 - 1.0) + rng.normal(0.0, NOISE_UM, index.size)
    reading[rng.choice(index.size, 60, replace=False)] += 50.0
    reading[rng.choice(index.size, 60, replace=False)] = np.nan
    kept = (index % 5000 > 40) | (index < 5000)
    found = cycle_metrics.sensor_noise_um(index[kept], reading[kept])
    assert found == pytest.approx(NOISE_UM, rel=0.05)


def test_joins_across_gaps_are_not_noise() -> None:
    index = np.concatenate([np.arange(20) + 1000 * k for k in range(50)]).astype(np.int64)
    assert cycle_metrics.sensor_noise_um(index, index * 1.0) == pytest.approx(0.0, abs=1e-9)


def test_too_few_samples_give_none() -> None:
    few = np.arange(30, dtype=np.int64)
    assert cycle_metrics.sensor_noise_um(few, few * 1.0) is None
    gappy = 2 * np.arange(1000, dtype=np.int64)
    assert cycle_metrics.sensor_noise_um(gappy, gappy * 1.0) is None


def test_expected_maximum_agrees_with_known_values() -> None:
    """One normal value has mean magnitude sqrt(2/pi), the larger of two 2/sqrt(pi)."""
    assert cycle_metrics.expected_maximum(1) == pytest.approx(np.sqrt(2.0 / np.pi), rel=1e-5)
    assert cycle_metrics.expected_maximum(2) == pytest.approx(2.0 / np.sqrt(np.pi), rel=1e-5)


@pytest.mark.parametrize(("period", "cycles"), [(50_000.0, 1), (200.0, 50), (1000.0 / 3.0, 90)])
def test_floor_is_what_a_straight_line_shows(period: float, cycles: int) -> None:
    """Over many draws, noise on a straight line shows the floor on average, within an eighth.

    Where bins of the two branches don't face each other, lines between points average a little.
    """
    index = np.arange(round(period * cycles), dtype=np.int64)
    line = 41.5 * np.sin(2.0 * np.pi * index / period)
    rng = np.random.default_rng(6)
    seen = []
    for _ in range(60):
        folded = cycle_metrics.fold(
            index, period, [line, line + rng.normal(0.0, NOISE_UM, index.size)]
        )
        seen.append(cycle_metrics.peak_hysteresis_percent(*folded.signals))
    expected = cycle_metrics.noise_floor_percent(NOISE_UM, folded.counts, 83.0)
    assert expected is not None
    assert np.mean(np.array(seen, dtype=float)) == pytest.approx(expected, rel=0.125)


def test_floor_of_no_stroke_or_no_bins_is_none() -> None:
    assert cycle_metrics.noise_floor_percent(NOISE_UM, np.ones(10, dtype=np.int64), 0.0) is None
    assert cycle_metrics.noise_floor_percent(NOISE_UM, np.empty(0, dtype=np.int64), 83.0) is None
