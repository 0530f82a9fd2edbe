"""Steady cycles: averaged from recordings and found in tables."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.lab.identify.data.cycles import (
    average_cycle,
    find_cycles,
    find_period,
    loops_from_pieces,
    steady_stretch,
)
from hilctl.lab.identify.data.records import History

RATE_HZ = 50_000.0


def sine_segment(frequency_hz: float, cycles: int, start: int = 0) -> tuple[np.ndarray, Segment]:
    """Return a 6 A sine without a soft start, and its segment."""
    period = RATE_HZ / frequency_hz
    n = round(cycles * period)
    command = 6.0 * np.sin(2.0 * np.pi * np.arange(n) / period)
    label = f"sine 6 A {frequency_hz:g} Hz"
    return command, Segment(label, start, start + n, start, start + n, period)


@pytest.mark.parametrize("frequency_hz", [10.0, 150.0, 250.0, 173.7])
def test_loops_keep_the_waveform_at_any_period(frequency_hz, recording_of):
    """300 points come out right whether a cycle has 5000, 333.3, 200 or 287.9 samples."""
    command, segment = sine_segment(frequency_hz, 8)
    (loop,) = loops_from_pieces([recording_of(command, -5.0 * command, [segment])])
    first = segment.steady_cycles()[0]
    turn = 2.0 * np.pi * (np.arange(300) / 300 + first / segment.period)
    np.testing.assert_allclose(loop.command, 6.0 * np.sin(turn), atol=6e-4)
    np.testing.assert_allclose(loop.displacement_um, -30.0 * np.sin(turn), atol=3e-3)
    assert loop.frequency_hz == pytest.approx(frequency_hz)
    assert loop.sample_rate_hz == RATE_HZ
    assert loop.label == segment.label


def test_averaging_takes_noise_out(recording_of):
    """Noise falls with the root of the samples in a bin: 19 cycles x 16.7 samples a point here."""
    command, segment = sine_segment(10.0, 20)
    noise = np.random.default_rng(5).normal(0.0, 1.0, command.size)
    (loop,) = loops_from_pieces([recording_of(command, command + noise, [segment])])
    left = loop.displacement_um - loop.command
    assert np.std(left) == pytest.approx(1.0 / np.sqrt(19 * 5000 / 300), rel=0.2)


def test_samples_missing_from_some_cycles_do_no_harm(recording_of):
    command, segment = sine_segment(100.0, 6)
    kept = np.flatnonzero((np.arange(command.size) < 900) | (np.arange(command.size) > 1100))
    recording = recording_of(command[kept], command[kept], [segment], index=kept)
    (loop,) = loops_from_pieces([recording])
    start = segment.steady_cycles()[0] / segment.period
    expected = 6.0 * np.sin(2.0 * np.pi * (np.arange(300) / 300 + start))
    np.testing.assert_allclose(loop.command, expected, atol=1e-3)


def test_loops_in_pieces_are_those_of_the_whole(recording_of):
    command, segment = sine_segment(100.0, 6)
    later = replace(
        segment, label="again", start=3000, stop=6000, steady_start=3500, steady_stop=5900
    )
    command = np.concatenate((command, command))
    noise = np.random.default_rng(5).normal(0.0, 1.0, command.size)
    recording = recording_of(command, command + noise, [segment, later])
    cuts = (slice(0, 10), slice(10, 2222), slice(2222, 2222), slice(2222, 4001), slice(4001, None))
    pieces = [replace(recording, samples=recording.samples.rows(cut)) for cut in cuts]
    for loop, whole in zip(loops_from_pieces(pieces), loops_from_pieces([recording]), strict=True):
        assert (loop.label, loop.frequency_hz) == (whole.label, whole.frequency_hz)
        np.testing.assert_allclose(loop.command, whole.command, rtol=0, atol=1e-12)
        np.testing.assert_allclose(loop.displacement_um, whole.displacement_um, atol=1e-12)


def test_a_phase_missing_from_all_cycles_is_refused():
    phase = np.arange(0, 500) / 100
    phase = phase[(phase % 1.0 < 0.4) | (phase % 1.0 > 0.5)]
    with pytest.raises(DataError, match=r"at 0\.4\d*"):
        average_cycle("run", phase, np.sin(phase)[None, :], 100.0, 300)


@pytest.mark.parametrize("reading", [1e308, np.inf, np.nan])
def test_readings_that_no_spline_can_hold_are_refused(reading):
    phase = np.arange(500) / 100
    values = np.sin(2.0 * np.pi * phase)
    values[7] = -reading
    values[8] = reading
    with pytest.raises(DataError, match="not finite"):
        average_cycle("run", phase, values[None, :], 100.0, 300)


def test_a_segment_without_steady_cycle_is_named(recording_of):
    command, segment = sine_segment(10.0, 2)
    short = Segment("step 1 A", 0, 5000, 0, 5000, 0.0)
    recording = recording_of(command, command, [segment, short])
    with pytest.raises(DataError, match=r"'step 1 A'"):
        loops_from_pieces([recording])
    assert len(loops_from_pieces([recording], labels=[segment.label])) == 1


def test_unknown_labels_are_refused_with_the_known_ones(recording_of):
    command, segment = sine_segment(10.0, 2)
    recording = recording_of(command, command, [segment])
    with pytest.raises(DataError, match=r"'sine 7 A'.*'sine 6 A 10 Hz'"):
        loops_from_pieces([recording], labels=["sine 7 A"])
    with pytest.raises(DataError, match="it has none"):
        loops_from_pieces([recording_of(command, command, [])])


def test_find_cycles_skips_rest_and_decay():
    period, rate_hz = 73.3, 200.0
    time = np.arange(2000)
    envelope = np.interp(time, [0, 300, 301, 1200, 1900], [0.0, 0.0, 1.0, 1.0, 0.0])
    wave = 1.8 * np.sin(2.0 * np.pi * time / period)
    loop = find_cycles(History("table", 1.8 + envelope * wave, 5.0 * envelope * wave, rate_hz), 60)
    assert loop.frequency_hz == pytest.approx(rate_hz / period, rel=1e-5)
    np.testing.assert_allclose(loop.displacement_um, 5.0 * (loop.command - 1.8), atol=0.02)
    assert np.ptp(loop.command) == pytest.approx(3.6, rel=0.01)


def test_find_cycles_takes_the_whole_period_of_two_tones():
    """Two tones at 50 and 100 Hz repeat at 50 Hz, though the second is the stronger."""
    time = np.arange(4000) / 10_000.0
    command = np.sin(2 * np.pi * 50.0 * time) + 5.0 * np.sin(2 * np.pi * 100.0 * time)
    loop = find_cycles(History("table", command, command, 10_000.0))
    assert loop.frequency_hz == pytest.approx(50.0, rel=1e-4)


@pytest.mark.parametrize("kind", ["noise", "ramp", "sweep", "growing"])
def test_find_cycles_refuses_what_does_not_repeat(kind):
    time = np.arange(3000)
    command = {
        "noise": np.random.default_rng(1).normal(size=3000),
        "ramp": time / 3000.0,
        "sweep": np.sin(2e-5 * time**2),
        "growing": time * np.sin(2.0 * np.pi * time / 200.0),
    }[kind]
    with pytest.raises(DataError, match=r"table: .*--whole"):
        find_cycles(History("table", command, command, 100.0))


def sine(period, cycles):
    return np.sin(2.0 * np.pi * np.arange(round(period * cycles)) / period)


@pytest.mark.parametrize("period", [40.0, 73.25, 333.3])
def test_a_period_is_found_to_a_part_of_a_sample(period):
    found, start, stop = find_period("sine", sine(period, 12))
    assert found == pytest.approx(period, rel=1e-4)
    assert start == 0
    assert stop >= round(period * 11)


def test_the_shortest_period_counts_and_not_a_multiple():
    two_tones = sine(100.0, 10) + 0.5 * sine(50.0, 20)
    assert find_period("tones", two_tones)[0] == pytest.approx(100.0, rel=1e-4)


def test_a_soft_start_is_left_out():
    command = sine(50.0, 12) * np.minimum(1.0, np.arange(600) / 200.0)
    _, start, stop = find_period("soft", command)
    assert 150 <= start <= 200
    assert stop >= 599


def test_a_stretch_at_a_small_part_of_the_amplitude_is_none():
    command = np.concatenate((0.01 * sine(50.0, 10), np.linspace(0.0, 1.0, 60)))
    assert steady_stretch(command, 50.0) is None
    assert steady_stretch(sine(50.0, 1.5), 50.0) is None


@pytest.mark.parametrize("cycles", [2, 3, 4])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("period", [100.0, 1000.0, 73.3])
def test_few_cycles_with_the_noise_of_a_measured_current_repeat(cycles, noise, period):
    """A hundredth of the amplitude is more than 2 % from cycle to cycle, somewhere."""
    time = np.arange(round(cycles * period))
    command = 6.0 * np.sin(2.0 * np.pi * time / period)
    command += np.random.default_rng(cycles).normal(0.0, 6.0 * noise, time.size)
    found, start, stop = find_period("four", command)
    assert found == pytest.approx(period, rel=0.01)
    assert stop - start >= 1.95 * period
