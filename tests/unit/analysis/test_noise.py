"""Sensor noise and its floor, held against noise of known strength."""

import numpy as np
import pytest

from hilctl.analysis import metrics, noise

NOISE_UM = 0.03553


@pytest.mark.parametrize("frequency_hz", [1.0, 150.0, 250.0])
def test_finds_the_published_noise_on_a_full_stroke(frequency_hz: float) -> None:
    """35.53 nm on 83 um at 50 kHz reads 35.5 nm within 0.8 %, at 1 Hz as at 250 Hz."""
    index = np.arange(400_000, dtype=np.int64)
    sine = 41.5 * np.sin(2.0 * np.pi * frequency_hz * index / 50_000)
    reading = sine + np.random.default_rng(3).normal(0.0, NOISE_UM, index.size)
    assert noise.sensor_noise_um(index, reading) == pytest.approx(NOISE_UM, rel=0.008)


def test_clean_signal_has_next_to_none() -> None:
    """The signal itself does not count: 250 Hz at 50 kHz leaves less than 0.1 nm."""
    index = np.arange(10_000, dtype=np.int64)
    found = noise.sensor_noise_um(index, 41.5 * np.sin(2.0 * np.pi * index / 200))
    assert found is not None
    assert found < 1e-4


def test_shortest_period_still_passes_for_smooth() -> None:
    """At 16 samples a period the signal adds less than a tenth to the published noise."""
    index = np.arange(200_000, dtype=np.int64)
    sine = 41.5 * np.sin(2.0 * np.pi * index / noise.SHORTEST_PERIOD)
    reading = sine + np.random.default_rng(4).normal(0.0, NOISE_UM, index.size)
    assert noise.sensor_noise_um(index, reading) == pytest.approx(NOISE_UM, rel=0.1)


def test_spikes_corners_and_gaps_do_not_count() -> None:
    """Outliers, a triangle's corners, NaN and missing samples leave the estimate where it was."""
    rng = np.random.default_rng(5)
    index = np.arange(60_000, dtype=np.int64)
    reading = 40.0 * np.abs((index / 1000) % 2.0 - 1.0) + rng.normal(0.0, NOISE_UM, index.size)
    reading[rng.choice(index.size, 60, replace=False)] += 50.0
    reading[rng.choice(index.size, 60, replace=False)] = np.nan
    kept = (index % 5000 > 40) | (index < 5000)
    found = noise.sensor_noise_um(index[kept], reading[kept])
    assert found == pytest.approx(NOISE_UM, rel=0.05)


def test_joins_across_gaps_are_not_noise() -> None:
    """A jump of the index between steps of the signal leaves a clean signal clean."""
    index = np.concatenate([np.arange(20) + 1000 * k for k in range(50)]).astype(np.int64)
    assert noise.sensor_noise_um(index, index * 1.0) == pytest.approx(0.0, abs=1e-9)


def test_too_few_samples_give_none() -> None:
    """No estimate from a handful of windows, nor from windows that all have a gap."""
    few = np.arange(30, dtype=np.int64)
    assert noise.sensor_noise_um(few, few * 1.0) is None
    gappy = 2 * np.arange(1000, dtype=np.int64)
    assert noise.sensor_noise_um(gappy, gappy * 1.0) is None


def test_expected_maximum_agrees_with_known_values() -> None:
    """One normal value has mean magnitude sqrt(2/pi), the larger of two 2/sqrt(pi)."""
    assert noise.expected_maximum(1) == pytest.approx(np.sqrt(2.0 / np.pi), rel=1e-5)
    assert noise.expected_maximum(2) == pytest.approx(2.0 / np.sqrt(np.pi), rel=1e-5)


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
        folded = metrics.fold(index, period, [line, line + rng.normal(0.0, NOISE_UM, index.size)])
        seen.append(metrics.peak_hysteresis_percent(*folded.signals))
    expected = noise.noise_floor_percent(NOISE_UM, folded.counts, 83.0)
    assert expected is not None
    assert np.mean(np.array(seen, dtype=float)) == pytest.approx(expected, rel=0.125)


def test_floor_of_no_stroke_or_no_bins_is_none() -> None:
    """A share of nothing has no meaning."""
    assert noise.noise_floor_percent(NOISE_UM, np.ones(10, dtype=np.int64), 0.0) is None
    assert noise.noise_floor_percent(NOISE_UM, np.empty(0, dtype=np.int64), 83.0) is None
