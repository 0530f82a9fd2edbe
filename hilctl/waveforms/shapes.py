"""Samples of a single waveform, as pure functions of time."""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.formatting import unit_text
from hilctl.base.types import CHUNK, F64, I64
from hilctl.waveforms import spec

MAX_SAMPLES = 100_000_000
"""Longest waveform in samples: 0.8 GB, 33 minutes at 50 kHz."""

LONG = 400_000
"""Length in samples above which only representative parts of a periodic waveform are checked."""

_TELLING_CYCLES = 8
_LONGEST_PERIOD = 2**31  # samples; products must fit an integer


def sample_count(duration_s: float, sample_rate_hz: float) -> int:
    """Return the samples in a duration, at least 1; raise InputError beyond :data:`MAX_SAMPLES`."""
    check_length(duration_s * sample_rate_hz)
    return max(1, round(duration_s * sample_rate_hz))


def check_length(samples: float) -> None:
    """Raise InputError if a waveform has more than :data:`MAX_SAMPLES`."""
    if samples > MAX_SAMPLES:
        raise InputError(
            f"has {samples:.10g} samples, more than the {MAX_SAMPLES} that fit in memory: "
            "shorten it, or lower sample_rate_hz"
        )


def outline(w: spec.Shape, unit: str) -> tuple[str, float, float]:
    """Return a waveform's label, its highest frequency in Hz, and its period in s or 0.0."""
    unit = unit_text(unit)
    match w:
        case spec.Sine() | spec.Triangle() | spec.GrowingOrDecaying():
            label = f"{w.kind} {w.amplitude:g} {unit} {w.frequency_hz:g} Hz"
            period_s = 0.0 if w.kind in {"growing", "decaying"} else 1.0 / w.frequency_hz
            return label, w.frequency_hz, period_s
        case spec.ComplexHarmonic():
            parts = [f"{c.amplitude:g} {unit} {c.frequency_hz:g} Hz" for c in w.components]
            frequencies = [c.frequency_hz for c in w.components]
            label = f"complex harmonic {' + '.join(parts)}"
            return label, max(frequencies), common_period_s(frequencies)
        case spec.Chirp():
            label = f"{w.kind} {w.amplitude:g} {unit} {w.start_hz:g}-{w.stop_hz:g} Hz"
            return label, max(w.start_hz, w.stop_hz), 0.0
        case spec.Multisine():
            label = f"{w.kind} {w.amplitude:g} {unit} {w.first_hz:g}-{w.last_hz:g} Hz"
            count = _multisine_count(w)
            common = [w.first_hz] if count == 1 else [w.first_hz, w.step_hz]
            return label, w.first_hz + (count - 1) * w.step_hz, common_period_s(common)
        case spec.RandomSines():
            label = f"{w.kind} {w.amplitude:g} {unit} {w.first_hz:g}-{w.last_hz:g} Hz"
            return f"{label} seed {w.seed}", w.last_hz, 0.0
        case spec.LevelPath():
            return f"{w.kind} {w.rate_per_s:g} {unit}/s", 0.0, 0.0
        case spec.Hold():
            return f"hold {w.level:g} {unit}", 0.0, 0.0
        case spec.Step():
            return w.kind, 0.0, 0.0


def sampled(w: spec.Shape, sample_rate_hz: float) -> F64:
    """Return every sample of a waveform with its offset, without soft start: float64[n]."""
    size = sample_count(_duration_s(w), sample_rate_hz)
    if isinstance(w, spec.RandomSines):
        return w.offset + _random(w, size)
    values = _computed(w, sample_rate_hz, size)
    if isinstance(w, spec.Multisine):
        values *= _multisine_scale(w, sample_rate_hz, values)
    values += w.offset
    return values


def _computed(w: spec.ShapeOfTime, sample_rate_hz: float, size: int) -> F64:
    """Return a waveform without offset, from one period if periodic: float64[n]."""
    once = np.empty(min(size, _period(w, sample_rate_hz) or size))
    for start in range(0, once.size, CHUNK):
        stop = min(start + CHUNK, once.size)
        once[start:stop] = _shape(w, _Instants(np.arange(start, stop), sample_rate_hz))
    return once if once.size == size else np.resize(once, size)


@dataclass(frozen=True, slots=True)
class _Instants:
    """Sampling instants: int64[n] sample numbers at a rate."""

    sample: I64
    rate_hz: float

    @property
    def t(self) -> F64:
        """Time in s: float64[n]."""
        return self.sample / self.rate_hz

    def cycles(self, frequency_hz: float) -> F64:
        """Return the phase of a frequency in cycles: float64[n], 0 to 1.

        Frequency and rate are used as the user's decimal numbers, so that all periods of a whole
        number of samples have the same bits. Rounded times would make cycles differ, like noise.
        """
        turn = _decimal(frequency_hz) / _decimal(self.rate_hz) % 1
        if turn.denominator > _LONGEST_PERIOD:
            return np.mod(frequency_hz * self.t, 1.0)
        inside = self.sample % turn.denominator * turn.numerator % turn.denominator
        return inside / turn.denominator


def _period(w: spec.ShapeOfTime, sample_rate_hz: float) -> int:
    """Return the number of samples after which all bits repeat; 0 if never or too late."""
    match w:
        case spec.Sine() | spec.Triangle():
            common = [w.frequency_hz]
        case spec.ComplexHarmonic():
            common = [part.frequency_hz for part in w.components]
        case spec.Multisine():
            common = [w.first_hz, w.step_hz]
        case _:
            return 0
    rate = _decimal(sample_rate_hz)
    period = math.lcm(*((_decimal(each) / rate).denominator for each in common))
    return period if period <= _LONGEST_PERIOD else 0


def _duration_s(w: spec.Shape) -> float:
    match w:
        case spec.Step():
            return w.dwell_s * len(w.levels)
        case spec.LevelPath():
            return float(_arrivals_s(w)[-1])
        case _:
            return w.duration_s


def _shape(w: spec.ShapeOfTime, at: _Instants) -> F64:
    match w:
        case spec.Sine():
            return w.amplitude * _sine(w.frequency_hz, math.radians(w.phase_deg), at)
        case spec.Triangle():
            return _triangle(w, at)
        case spec.ComplexHarmonic():
            return _complex_harmonic(w, at)
        case spec.GrowingOrDecaying():
            elapsed = at.t / w.duration_s
            envelope = elapsed if w.kind == "growing" else 1.0 - elapsed
            angle = math.radians(w.phase_deg)
            return w.amplitude * envelope * _sine(w.frequency_hz, angle, at)
        case spec.Chirp():
            return _chirp(w, at.t)
        case spec.Multisine():
            return _multisine(w, at)
        case spec.Step():
            return _step(w, at.t)
        case spec.Hold():
            return np.full(at.sample.size, w.level)
        case spec.LevelPath():
            return np.interp(at.t, _arrivals_s(w), _levels(w))


def _sine(frequency_hz: float, angle: float, at: _Instants) -> F64:
    return np.sin(2.0 * np.pi * at.cycles(frequency_hz) + angle)


def _triangle(w: spec.Triangle, at: _Instants) -> F64:
    """Return a triangle that rises in its share of each period: float64[n]."""
    # Phase 0 is in the middle of the rise, and 0 here is the lowest point.
    cycles = np.mod(at.cycles(w.frequency_hz) + (w.phase_deg / 360.0 + 0.5 * w.rise), 1.0)
    after = cycles - w.rise
    values: F64 = 1.0 - 2.0 * np.where(after < 0.0, -after / w.rise, after / (1.0 - w.rise))
    return w.amplitude * values


def _complex_harmonic(w: spec.ComplexHarmonic, at: _Instants) -> F64:
    total = np.zeros(at.sample.size)
    for part in w.components:
        total += part.amplitude * _sine(part.frequency_hz, math.radians(part.phase_deg), at)
    return total


def _chirp(w: spec.Chirp, t: F64) -> F64:
    """Return a sine of moving frequency: float64[n]."""
    growth = (math.log(w.stop_hz) - math.log(w.start_hz)) / w.duration_s
    if w.spacing == "linear" or growth == 0.0:
        slope = (w.stop_hz - w.start_hz) / w.duration_s
        cycles = w.start_hz * t + 0.5 * slope * t**2
    else:
        cycles = w.start_hz * np.expm1(growth * t) / growth
    return w.amplitude * np.sin(2.0 * np.pi * cycles)


def _step(w: spec.Step, t: F64) -> F64:
    """Return levels, each reached linearly in ``rise_s``: float64[n]."""
    levels = _levels(w)
    index = np.minimum((t / w.dwell_s + 1e-12).astype(np.int64), len(w.levels) - 1)
    since = t - index * w.dwell_s
    part = np.ones_like(t) if w.rise_s == 0.0 else np.clip(since / w.rise_s, 0.0, 1.0)
    values: F64 = levels[index] + part * (levels[index + 1] - levels[index])
    return values


def _multisine(w: spec.Multisine, at: _Instants) -> F64:
    """Return evenly spaced sines with Schroeder phases, unscaled: float64[n].

    Source: M. R. Schroeder, IEEE Trans. Information Theory 16 (1970) 85: phases with a low crest
    factor, ``phi_m = -pi m (m - 1) / M``.
    """
    count = _multisine_count(w)
    first_hz, step_hz = _decimal(w.first_hz), _decimal(w.step_hz)
    total = np.zeros(at.sample.size)
    for m in range(count):
        total += _sine(float(first_hz + m * step_hz), -math.pi * m * (m + 1) / count, at)
    return total


def _multisine_scale(w: spec.Multisine, sample_rate_hz: float, values: F64) -> float:
    """Return the factor that scales the peak of a multisine to its amplitude."""
    told = values.size
    if told > LONG:
        period = outline(w, "")[2] * sample_rate_hz
        told = min(told, telling_samples(period) if math.isfinite(period) else told)
    peak = float(np.max(np.abs(values[:told])))
    return 1.0 if peak == 0.0 else w.amplitude / peak


def telling_samples(period: float) -> int:
    """Return the number of representative samples of a periodic part, by its finite period > 0."""
    # Cycles differ unless the period is a whole number of samples, so several are needed.
    cycles = 1 if period.is_integer() else _TELLING_CYCLES
    return CHUNK + math.ceil(cycles * period)


def _random(w: spec.RandomSines, size: int) -> F64:
    """Return sines with random phases at all multiples of 1 / duration within the band: float64[n].

    The sum is an inverse FFT, because the number of sines grows with the duration.
    """
    first, last = math.ceil(w.first_hz * w.duration_s), math.floor(w.last_hz * w.duration_s)
    phases = np.random.default_rng(w.seed).random(last - first + 1)
    spectrum = np.zeros(size // 2 + 1, dtype=np.complex128)
    spectrum[first : last + 1] = np.exp(2j * np.pi * phases)[: spectrum.size - first]
    total = np.fft.irfft(spectrum, size)
    return w.amplitude / float(np.max(np.abs(total))) * total


def _levels(w: spec.LevelPath | spec.Step) -> F64:
    """Return the levels including the initial one: float64[m + 1]."""
    return np.array((w.rest_value - w.offset, *w.levels))


def _arrivals_s(w: spec.LevelPath) -> F64:
    """Return the start time of the path and its arrival at each level: float64[m + 1], in s."""
    lengths = np.abs(np.diff(_levels(w)))
    return np.concatenate(([0.0], np.cumsum(lengths))) / w.rate_per_s


def _multisine_count(w: spec.Multisine) -> int:
    """Return the number of sines in a multisine."""
    return int((w.last_hz - w.first_hz) / w.step_hz + 1e-9) + 1


def _decimal(value: float) -> Fraction:
    """Return the shortest decimal number of a value."""
    return Fraction(repr(float(value)))


def common_period_s(frequencies_hz: list[float]) -> float:
    """Return the shortest period that all frequencies share, in s.

    Frequencies are used as the decimal numbers that the user wrote, so 0.1 and 0.3 Hz share 10 s.
    Infinite if the period is too long for a float.
    """
    fractions = [_decimal(f) for f in frequencies_hz]
    periods = math.lcm(*(each.denominator for each in fractions))
    try:
        return float(Fraction(periods, math.gcd(*(each.numerator for each in fractions))))
    except OverflowError:
        return math.inf
