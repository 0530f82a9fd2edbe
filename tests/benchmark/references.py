"""The references on which ``physics.py`` evaluates an inverse, each with its class and goal."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hilctl.base.types import F64
from hilctl.waveforms import spec
from hilctl.waveforms.shapes import sampled

RATE_HZ = 50_000.0
GOALS = {
    "sine 100 %": 0.5,
    "sine 50 %": 1.0,
    "sine 25 %": 1.0,
    "sine 10 %": 2.0,
    "complex": 1.0,
    "triangle": 1.0,
    "multisine": 1.5,
    "chirp": 1.5,
    "random": 1.5,
}
"""Largest peak error of each class of references, percent of a reference's own peak-to-peak."""
_UNJUDGED = 250  # samples at the end, where the reference that an inverse looks ahead to stops
_FREQUENCIES_HZ = (1.0, 20.0, 100.0, 250.0)
_SWELL_S = 0.05
_CORNER_S = 0.5e-3


@dataclass(frozen=True, slots=True)
class Row:
    """A reference.

    Attributes:
        group: Its class, a key of ``GOALS``.
        reference_um: float64[n], from rest.
        judged: bool[n], the evaluated samples.
    """

    group: str
    name: str
    reference_um: F64
    judged: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Stroke:
    """Range of references and displacement at rest, in um."""

    low_um: float
    high_um: float
    rest_um: float

    def row(
        self, group: str, detail: str, wave: F64, begin_s: float = _SWELL_S, *, place: float = 0.0
    ) -> Row:
        """Return a row for a wave of -1 to 1 about ``place`` of -1 to 1, with a soft start."""
        half_um = 0.5 * (self.high_um - self.low_um)
        middle_um = 0.5 * (self.low_um + self.high_um) + place * half_um
        time_s = np.arange(wave.size) / RATE_HZ
        swelling = 0.5 - 0.5 * np.cos(np.pi * np.clip(time_s / begin_s, 0.0, 1.0))
        judged = np.zeros(wave.size, dtype=np.bool_)
        judged[round(begin_s * RATE_HZ) : -_UNJUDGED] = True
        reference_um = self.rest_um + swelling * (middle_um - self.rest_um + half_um * wave)
        return Row(group, f"{group}, {detail}", reference_um, judged)


def references(stroke: Stroke) -> Iterator[Row]:
    """Yield all rows within a stroke."""
    for part in (1.0, 0.5, 0.25, 0.1):
        places = {"": 0.0, " low": part - 1.0, " high": 1.0 - part} if part < 1.0 else {"": 0.0}
        for label, place in places.items():
            for frequency_hz in _FREQUENCIES_HZ:
                begin_s = max(0.04, 1.0 / frequency_hz)
                wave = part * _sine(frequency_hz, begin_s)
                group, detail = f"sine {100 * part:.0f} %", f"{frequency_hz:g} Hz{label}"
                yield stroke.row(group, detail, wave, begin_s, place=place)
    for low_hz in (50.0, 100.0):
        yield stroke.row("complex", f"{low_hz:g} and {2 * low_hz:g} Hz", _complex(low_hz))
    yield _triangle(stroke)
    for part, seed in ((1.0, 5), (0.5, 6)):
        percent = f"{100 * part:.0f} %"
        yield stroke.row("random", percent, part * _random(seed))
        yield stroke.row("multisine", percent, part * _multisine())
        yield stroke.row("chirp", percent, part * _chirp())


def _random(seed: int) -> F64:
    """Return a band-limited random wave, 5 to 200 Hz, of -1 to 1."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(0.8 * RATE_HZ)) / RATE_HZ
    sines = [
        np.sin(2.0 * np.pi * frequency * time_s + rng.uniform(0.0, 2.0 * np.pi))
        for frequency in rng.uniform(5.0, 200.0, 40)
    ]
    wave = np.sum(sines, axis=0)
    return np.asarray(wave / np.max(np.abs(wave)))


def _sine(frequency_hz: float, begin_s: float) -> F64:
    samples = round((begin_s + max(0.04, 2.0 / frequency_hz)) * RATE_HZ) + _UNJUDGED
    return np.asarray(np.sin(2.0 * np.pi * frequency_hz * np.arange(samples) / RATE_HZ))


def _complex(low_hz: float) -> F64:
    """Return the published one, a part at the lower frequency and five at the upper."""
    parts = tuple(
        spec.Harmonic(amplitude=amplitude, frequency_hz=frequency_hz)
        for amplitude, frequency_hz in ((1.0, low_hz), (5.0, 2.0 * low_hz))
    )
    shape = spec.ComplexHarmonic(kind="complex_harmonic", components=parts, duration_s=0.16)
    wave = sampled(shape, RATE_HZ)
    return wave / float(np.max(np.abs(wave)))


def _triangle(stroke: Stroke) -> Row:
    """Return 100 Hz, evaluated away from its corners, which no structure with a mass follows."""
    shape = spec.Triangle(kind="triangle", amplitude=1.0, frequency_hz=100.0, duration_s=0.13)
    row = stroke.row("triangle", "100 Hz", sampled(shape, RATE_HZ))
    turns = np.mod(100.0 * np.arange(row.judged.size) / RATE_HZ - 0.25, 0.5)
    row.judged[np.minimum(turns, 0.5 - turns) < 100.0 * _CORNER_S] = False
    return row


def _multisine() -> F64:
    shape = spec.Multisine(
        kind="multisine", amplitude=1.0, first_hz=5.0, last_hz=200.0, step_hz=5.0, duration_s=0.6
    )
    return sampled(shape, RATE_HZ)


def _chirp() -> F64:
    shape = spec.Chirp(kind="chirp", amplitude=1.0, start_hz=5.0, stop_hz=250.0, duration_s=0.8)
    return sampled(shape, RATE_HZ)
