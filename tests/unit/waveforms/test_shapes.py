"""Every kind of waveform against its closed form, written out here a second time."""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, ClassVar

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.waveforms import shapes, spec
from hilctl.waveforms.build import Reference
from hilctl.waveforms.shapes import common_period_s, sample_count

RATE_HZ = 2000.0
Made = Callable[..., Reference]


def sampled(value: Callable[[float], float], n: int, rate_hz: float = RATE_HZ) -> F64:
    return np.array([value(k / rate_hz) for k in range(n)])


def triangle_wave(cycles: float, rise: float = 0.5) -> float:
    corners = (0.0, 0.5 * rise, 1.0 - 0.5 * rise, 1.0)
    return float(np.interp(cycles % 1.0, corners, (0.0, 1.0, -1.0, 0.0)))


CASES: list[tuple[dict[str, Any], Callable[[float], float]]] = [
    ({"kind": "sine", "amplitude": 6.0, "frequency_hz": 12.5, "duration_s": 0.5},
     lambda t: 6.0 * math.sin(2 * math.pi * 12.5 * t)),
    ({"kind": "sine", "amplitude": 2.0, "frequency_hz": 100, "phase_deg": -30.0, "offset": -7.25,
      "duration_s": 0.3},
     lambda t: -7.25 + 2.0 * math.sin(2 * math.pi * 100 * t - math.pi / 6)),
    ({"kind": "triangle", "amplitude": 3.0, "frequency_hz": 7.0, "offset": 1.0, "duration_s": 0.4},
     lambda t: 1.0 + 3.0 * triangle_wave(7.0 * t)),
    ({"kind": "triangle", "amplitude": 3.0, "frequency_hz": 7.0, "rise": 0.9, "duration_s": 0.4},
     lambda t: 3.0 * triangle_wave(7.0 * t, 0.9)),
    ({"kind": "triangle", "amplitude": 3.0, "frequency_hz": 7.0, "rise": 0.2, "phase_deg": -90.0,
      "offset": 1.0, "duration_s": 0.4},
     lambda t: 1.0 + 3.0 * triangle_wave(7.0 * t - 0.25, 0.2)),
    ({"kind": "complex_harmonic", "duration_s": 0.2, "components": (
        {"amplitude": 4.0, "frequency_hz": 20.0},
        {"amplitude": 3.0, "frequency_hz": 60.0, "phase_deg": 90.0})},
     lambda t: 4.0 * math.sin(2 * math.pi * 20 * t) + 3.0 * math.cos(2 * math.pi * 60 * t)),
    ({"kind": "growing", "amplitude": 7.0, "frequency_hz": 10.0, "duration_s": 1.0},
     lambda t: 7.0 * t * math.sin(2 * math.pi * 10 * t)),
    ({"kind": "decaying", "amplitude": 7.0, "frequency_hz": 10.0, "duration_s": 2.0},
     lambda t: 7.0 * (1 - t / 2.0) * math.sin(2 * math.pi * 10 * t)),
    ({"kind": "growing", "amplitude": 7.0, "frequency_hz": 10.0, "phase_deg": 90.0,
      "duration_s": 1.0}, lambda t: 7.0 * t * math.cos(2 * math.pi * 10 * t)),
    ({"kind": "chirp", "amplitude": 2.0, "start_hz": 5.0, "stop_hz": 45.0, "duration_s": 0.8},
     lambda t: 2.0 * math.sin(2 * math.pi * (5.0 * t + 25.0 * t * t))),
    ({"kind": "chirp", "amplitude": 2.0, "start_hz": 45.0, "stop_hz": 5.0, "duration_s": 0.8},
     lambda t: 2.0 * math.sin(2 * math.pi * (45.0 * t - 25.0 * t * t))),
    ({"kind": "chirp", "amplitude": 2.0, "start_hz": 5.0, "stop_hz": 80.0,
      "spacing": "logarithmic", "duration_s": 0.5},
     lambda t: 2.0 * math.sin(2 * math.pi * 5.0 * 0.5 / math.log(16) * (16 ** (2 * t) - 1))),
    ({"kind": "chirp", "amplitude": 2.0, "start_hz": 80.0, "stop_hz": 5.0,
      "spacing": "logarithmic", "duration_s": 0.5},
     lambda t: 2.0 * math.sin(2 * math.pi * 80.0 * 0.5 / math.log(16) * (1 - 16 ** (-2 * t)))),
    ({"kind": "hold", "level": -3.5, "offset": 1.0, "duration_s": 0.1}, lambda _: -2.5),
]  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "closed_form"), CASES, ids=[f"{i}-{keys['kind']}" for i, (keys, _) in enumerate(CASES)]
)
def test_closed_form(
    made: Made, keys: dict[str, Any], closed_form: Callable[[float], float]
) -> None:
    reference = made(RATE_HZ, **keys)
    n = round(keys["duration_s"] * RATE_HZ)
    assert reference.values.dtype == np.float64
    assert reference.values.shape == (n,)
    np.testing.assert_allclose(reference.values, sampled(closed_form, n), rtol=0.0, atol=1e-11)
    assert reference.unit == "A"
    assert reference.sample_rate_hz == RATE_HZ


@pytest.mark.parametrize("rise", [1e-300, 1e-3, 0.5, 0.999, 1.0 - 2.0**-53])
@pytest.mark.parametrize("phase_deg", [0.0, 720.0, -1e-15])
def test_triangle_starts_at_its_offset_within_its_range(
    made: Made, rise: float, phase_deg: float
) -> None:
    keys = {"amplitude": 3.0, "frequency_hz": 7.0, "duration_s": 1.0, "offset": 2.0}
    values = made(RATE_HZ, kind="triangle", rise=rise, phase_deg=phase_deg, **keys).values
    assert np.max(np.abs(values - 2.0)) <= 3.0
    if rise > 1e-3:
        assert values[0] == pytest.approx(2.0, abs=1e-9)
        assert values[1] > values[0]


@pytest.mark.parametrize("frequency_hz", [10.0, 30.0])
def test_raster_steps_once_per_line_in_the_flyback(made: Made, frequency_hz: float) -> None:
    """A triangle that begins with its flyback, and a step per period that ends within it."""
    lines, rate_hz, period_s = 256, 10_000.0, 1.0 / frequency_hz
    x = made(rate_hz, kind="triangle", amplitude=40.0, frequency_hz=frequency_hz, rise=0.9,
             phase_deg=162.0, duration_s=lines * period_s)  # fmt: skip
    y = made(rate_hz, kind="step", levels=tuple(range(1, lines + 1)), dwell_s=period_s,
             rise_s=0.08 * period_s)  # fmt: skip
    assert x.values.size == y.values.size
    line = np.floor(np.arange(x.values.size) / rate_hz * frequency_hz + 1e-9)
    assert line[-1] == lines - 1
    scanning = np.append(np.diff(x.values), 1.0) > 0.0
    np.testing.assert_array_equal(y.values[scanning], 1.0 + line[scanning])
    assert np.bincount(line[scanning].astype(int)).min() > 0.9 * rate_hz * period_s - 2.0


class TestStep:
    def test_rise_is_linear_from_the_level_before(self, made: Made) -> None:
        """A level is reached from the one before, the first from 0, in rise_s."""
        values = made(10.0, kind="step", levels=(4.0, 2.0), dwell_s=1.0, rise_s=0.4).values
        first = [0.0, 1.0, 2.0, 3.0] + [4.0] * 6
        second = [4.0, 3.5, 3.0, 2.5] + [2.0] * 6
        np.testing.assert_allclose(values, first + second, rtol=0.0, atol=1e-12)

    def test_first_rise_begins_at_rest(self, made: Made) -> None:
        keys = {"offset": 10.0, "rest": 9.0, "dwell_s": 1.0, "rise_s": 0.4}
        values = made(10.0, kind="step", levels=(3.0,), **keys).values
        np.testing.assert_allclose(values[:5], [9.0, 10.0, 11.0, 12.0, 13.0], atol=1e-12)

    def test_dwells_that_are_no_binary_fraction(self, made: Made) -> None:
        """Two thousand dwells of 0.1 s at 10 Hz are one sample each, none early or late."""
        levels = tuple(float(k) for k in range(2000))
        values = made(10.0, kind="step", levels=levels, dwell_s=0.1).values
        np.testing.assert_array_equal(values, levels)


class TestRandom:
    KEYS: ClassVar[dict[str, Any]] = {
        "kind": "random", "amplitude": 3.0, "first_hz": 5.0, "last_hz": 200.0, "duration_s": 2.0,
    }  # fmt: skip

    def test_band(self, made: Made) -> None:
        """All lines from the first to the last frequency are alike, and nothing is elsewhere."""
        lines = np.abs(np.fft.rfft(made(RATE_HZ, **self.KEYS).values))
        within = lines[10:401]
        np.testing.assert_allclose(within, within.mean(), rtol=1e-9)
        assert np.max(np.delete(lines, slice(10, 401))) < 1e-9 * within.mean()

    def test_peak_is_the_amplitude_beside_the_offset(self, made: Made) -> None:
        values = made(RATE_HZ, **self.KEYS, offset=-1.0).values
        assert np.max(np.abs(values + 1.0)) == pytest.approx(3.0)

    def test_another_seed_is_another_waveform(self, made: Made) -> None:
        first, second = (made(RATE_HZ, **self.KEYS, seed=seed).values for seed in (1, 2))
        assert abs(np.corrcoef(first, second)[0, 1]) < 0.2
        np.testing.assert_array_equal(first, made(RATE_HZ, **self.KEYS, seed=1).values)

    def test_random_waveform_does_not_repeat(self, made: Made) -> None:
        values = made(RATE_HZ, **self.KEYS).values
        spectrum = np.abs(np.fft.rfft(values, 2 * values.size)) ** 2
        alike = np.fft.irfft(spectrum)[: values.size]
        assert np.max(np.abs(alike[40:])) < 0.4 * alike[0]


class TestPath:
    def test_lines(self, made: Made) -> None:
        """From 0 to 2, to -1, to 0.5 at 10 a second."""
        values = made(RATE_HZ, kind="path", levels=(2.0, -1.0, 0.5), rate_per_s=10.0).values
        times_s, levels = (0.0, 0.2, 0.5, 0.65), (0.0, 2.0, -1.0, 0.5)
        expected = np.interp(np.arange(1300) / RATE_HZ, times_s, levels)
        np.testing.assert_allclose(values, expected, atol=1e-12)

    def test_begins_at_rest(self, made: Made) -> None:
        values = made(
            100.0, kind="path", levels=(2.0,), rate_per_s=1.0, offset=50.0, rest=49.0
        ).values
        assert values[0] == 49.0
        np.testing.assert_allclose(np.diff(values), 0.01)
        assert values[-1] == pytest.approx(51.99)


class TestChirp:
    @pytest.mark.parametrize("stop_hz", [5.0, np.nextafter(5.0, 6.0)])
    def test_chirp_of_constant_frequency(self, made: Made, stop_hz: float) -> None:
        keys = {"start_hz": 5.0, "stop_hz": float(stop_hz), "duration_s": 1.0}
        values = made(1000.0, kind="chirp", amplitude=2.0, spacing="logarithmic", **keys).values
        expected = sampled(lambda t: 2.0 * math.sin(10 * math.pi * t), 1000, 1000.0)
        np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-11)

    def test_chirp_to_a_tiny_frequency(self, made: Made) -> None:
        keys = {"start_hz": 400.0, "stop_hz": 1e-320, "duration_s": 1.0}
        values = made(1000.0, kind="chirp", amplitude=2.0, spacing="logarithmic", **keys).values
        assert np.isfinite(values).all()


BAND: dict[str, Any] = {"kind": "multisine", "first_hz": 10.0, "last_hz": 100.0, "step_hz": 5.0}


class TestMultisine:
    def test_lines(self, made: Made) -> None:
        """The spectrum has equal lines at first, first + step, ... last, and nothing else."""
        values = made(1000.0, amplitude=3.0, duration_s=2.0, **BAND).values
        lines = np.abs(np.fft.rfft(values)) / (values.size / 2)
        wanted = np.zeros(lines.size, dtype=bool)
        wanted[20:201:10] = True  # bins of 0.5 Hz
        assert np.count_nonzero(wanted) == 19
        np.testing.assert_allclose(lines[wanted], lines[20], rtol=1e-9)
        assert lines[20] > 0.1
        assert lines[~wanted].max() < 1e-11

    def test_phases(self, made: Made) -> None:
        """Of M sines the m-th, counted from 1, has Schroeder's phase -pi m (m - 1) / M."""
        values = made(1000.0, amplitude=3.0, duration_s=2.0, **BAND).values
        lines = np.fft.rfft(values)[20:201:10]
        m = np.arange(1, 20)
        expected = np.exp(-1j * np.pi * m * (m - 1) / 19) / 1j  # of a sine, seen as a cosine
        np.testing.assert_allclose(lines / np.abs(lines), expected, rtol=0.0, atol=1e-9)

    @pytest.mark.parametrize("amplitude", [0.5, 6.0])
    def test_peak_is_the_amplitude(self, made: Made, amplitude: float) -> None:
        values = made(5000.0, amplitude=amplitude, duration_s=1.0, offset=2.0, **BAND).values
        assert np.max(np.abs(values - 2.0)) == pytest.approx(amplitude, rel=1e-12)

    def test_one_sine(self, made: Made) -> None:
        keys = {"first_hz": 10.0, "last_hz": 14.9, "step_hz": 5.0}
        reference = made(1000.0, kind="multisine", amplitude=2.0, duration_s=1.0, **keys)
        expected = sampled(lambda t: 2.0 * math.sin(20 * math.pi * t), 1000, 1000.0)
        np.testing.assert_allclose(reference.values, expected, rtol=0.0, atol=1e-11)
        assert reference.segments[0].period == pytest.approx(100.0)

    def test_a_step_that_is_no_binary_fraction(self, made: Made) -> None:
        """0.1 to 0.7 Hz in steps of 0.1 Hz are seven sines, the last included."""
        keys = {"first_hz": 0.1, "last_hz": 0.7, "step_hz": 0.1}
        values = made(10.0, kind="multisine", amplitude=1.0, duration_s=100.0, **keys).values
        lines = np.abs(np.fft.rfft(values))
        np.testing.assert_array_equal(
            np.flatnonzero(lines > 1e-6 * lines.max()), np.arange(10, 71, 10)
        )

    def test_one_sample(self, made: Made) -> None:
        """A multisine too short to leave 0 is 0, not a division by it."""
        keys = {"first_hz": 10.0, "last_hz": 10.0, "step_hz": 1.0}
        values = made(1000.0, kind="multisine", amplitude=2.0, duration_s=0.001, **keys).values
        np.testing.assert_array_equal(values, [0.0])


@pytest.mark.parametrize(("duration_s", "rate_hz", "samples"), [
    (30.0, 50e3, 1_500_000),
    (0.29, 100.0, 29),
    (2.3, 50e3, 115_000),
    (1.1, 10.0, 11),
    (1.0 / 3.0, 3.0, 1),
    (0.00149, 1000.0, 1),
    (1e-9, 50e3, 1),
])  # fmt: skip
def test_sample_count(duration_s: float, rate_hz: float, samples: int) -> None:
    assert sample_count(duration_s, rate_hz) == samples


@pytest.mark.parametrize(("frequencies_hz", "period_s"), [
    ([10.0], 0.1),
    ([20.0, 60.0], 0.05),
    ([0.1, 0.3], 10.0),
    ([2.5, 1.25], 0.8),
    ([0.7, 1.1], 10.0),
    ([1.0, 1.5, 0.25], 4.0),
    ([33.3, 66.6], 1.0 / 33.3),
    ([50.0, 50.0], 0.02),
    ([1e-7, 1.0], 1e7),
])  # fmt: skip
def test_common_period(frequencies_hz: list[float], period_s: float) -> None:
    assert common_period_s(frequencies_hz) == pytest.approx(period_s, rel=1e-15)
    assert common_period_s(frequencies_hz[::-1]) == pytest.approx(period_s, rel=1e-15)
    for f in frequencies_hz:
        assert period_s * f == pytest.approx(round(period_s * f), rel=1e-12)


def test_common_period_too_long_for_a_float() -> None:
    assert common_period_s([1e-320, 1.0]) == math.inf


def test_values_are_read_only(made: Made) -> None:
    values = made(RATE_HZ, **CASES[0][0]).values
    with pytest.raises(ValueError, match="read-only"):
        values[0] = 1.0


@pytest.mark.parametrize(
    ("frequency_hz", "rate_hz", "period"),
    [(100.0, 50_000.0, 500), (0.1, 50_000.0, 500_000), (33.3, 1000.0, 10_000), (7.0, 48_000.1, 0)],
)
@pytest.mark.parametrize("kind", ["sine", "triangle", "sawtooth", "multisine"])
def test_cycles_are_the_same_bit_for_bit(kind, frequency_hz, rate_hz, period):
    common: dict[str, Any] = {"amplitude": 3.0, "unit": "um"}
    common["duration_s"] = (2 * period + 700) / rate_hz
    shape: spec.Sine | spec.Triangle | spec.Multisine
    if kind == "multisine":
        band = {"first_hz": frequency_hz, "last_hz": 2.5 * frequency_hz, "step_hz": frequency_hz}
        shape = spec.Multisine(kind=kind, **band, **common)
    else:
        common |= {"frequency_hz": frequency_hz, "phase_deg": 0.0 if kind == "sine" else 30.0}
        shape = (
            spec.Sine(kind="sine", **common)
            if kind == "sine"
            else spec.Triangle(kind="triangle", rise=0.5 if kind == "triangle" else 0.9, **common)
        )
    values = shapes.sampled(shape, rate_hz)
    turn = Fraction(repr(frequency_hz)) / Fraction(repr(rate_hz))

    def computed(at: int) -> F64:
        return shapes._shape(shape, shapes._Instants(np.arange(at, at + 700), rate_hz))

    if period:
        assert (turn * period).denominator == 1
        np.testing.assert_array_equal(values[period : 2 * period], values[:period])
        for later in (1, 12_345):
            np.testing.assert_array_equal(computed(later * period), computed(0))
    if kind == "sine":
        at = 4_000_000_000
        right = [3.0 * math.sin(2.0 * math.pi * (turn * k % 1)) for k in range(at, at + 700)]
        np.testing.assert_allclose(computed(at), right, rtol=0.0, atol=2e-14)


def test_periods_longer_than_numbers_hold_are_rounded():
    sine = spec.Sine(kind="sine", amplitude=1.0, frequency_hz=1.0 / 3.0, duration_s=10.0, unit="um")
    values = shapes.sampled(sine, 10_000.0 / 7.0)
    t = np.arange(values.size) / (10_000.0 / 7.0)
    np.testing.assert_allclose(values, np.sin(2.0 * np.pi / 3.0 * t), rtol=0.0, atol=1e-14)
