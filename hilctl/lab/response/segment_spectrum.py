"""Spectrum of the displacement: harmonics of a sine, noise, drift and Allan deviation at rest."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hilctl.analysis.steady_state import steady_samples
from hilctl.base.errors import DataError
from hilctl.base.files import write_text
from hilctl.base.formatting import quantity, shown_briefly
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.lab.identify.data.data_files import without_gaps
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import NAMED, plain_numbers
from hilctl.lab.spectrum import (
    allan_deviation,
    amplitude_spectrum,
    density,
    each_cycle,
    in_bands,
)
from hilctl.recording.recording import Recording

_HARMONICS = 20
_LINE_CYCLES = 8.0  # cycles of a sine in each averaged spectrum, so that lines are narrow
_FEWEST_CYCLES = 2
_FEWEST_SAMPLES = 16
_FLICKER = math.sqrt(2.0 * math.log(2.0) / math.pi)  # Allan deviation over bias instability
_BANDS = 800
_NM = 1e3  # per um


@dataclass(frozen=True, slots=True)
class RestNoise:
    """Sensor signal at rest."""

    mean_um: float
    noise_um: float  # rms about the linear trend
    peak_um: float  # largest deviation from the linear trend
    span_um: float  # range of the readings
    drift_um_per_s: float  # slope of the linear trend
    line_hz: float  # frequency of the strongest spectral line
    line_um: float  # its amplitude
    # Lowest Allan deviation over 0.664; an upper bound if it still falls at the longest time.
    bias_instability_um: float
    bias_time_s: float  # averaging time of the lowest Allan deviation
    averaging_s: F64  # float64[m], averaging times
    allan_um: F64  # float64[m], overlapping Allan deviation of means over each time


@dataclass(frozen=True, slots=True)
class SineHarmonics:
    """Harmonics of the displacement in the steady cycles of a sine."""

    frequency_hz: float
    cycles: int
    harmonics_um: F64  # float64[h], amplitudes at 1, 2, ... times the frequency
    noise_um: F64  # float64[h], their standard errors, from the scatter of the cycles
    thd_percent: float  # root of the sum of squares of the further harmonics, of the first
    thd_noise_percent: float  # distortion that the noise alone would cause


@shown_briefly
@dataclass(frozen=True, slots=True)
class SegmentSpectrum:
    """Spectrum of the displacement in one segment.

    Attributes:
        start_s: Time of the first evaluated sample in the run.
        duration_s: Duration of the evaluated samples.
        frequency_hz: float64[k], > 0.
        density_um: float64[k], amplitude density, um per root Hz.
        median_density_um: Its median: the noise between the lines, um per root Hz.
        rest: Noise, drift and Allan deviation; None unless the segment is at rest.
        sine: Harmonics; None unless the segment is a sine.
    """

    path: Path
    label: str
    start_s: float
    duration_s: float
    frequency_hz: F64
    density_um: F64
    median_density_um: float
    rest: RestNoise | None
    sine: SineHarmonics | None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, as ``hilctl spectrum --json`` prints them."""
        return {**asdict(self, dict_factory=_plain), "path": str(self.path)}


def _plain(values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {key: each.tolist() if isinstance(each, np.ndarray) else each for key, each in values}


def spectra(recording: Recording) -> tuple[SegmentSpectrum, ...]:
    """Return the spectra of the segments at rest and of the sines with two steady cycles.

    Raise DataError if there is no such segment, or too many of its samples are missing.
    """
    found = [each for part in recording.segments if (each := _spectrum(recording, part))]
    if not found:
        labels = ", ".join(each.label for each in recording.segments) or "no waveform"
        raise DataError(
            f"{recording.path}: has neither a sine with {_FEWEST_CYCLES} steady cycles nor a part"
            f" at rest ({labels}): record a waveform of kind hold (hilctl examples noise_floor), or"
            " select a part at rest with --from and --to"
        )
    return tuple(found)


def rest_noise(values_um: F64, sample_rate_hz: float) -> RestNoise:
    """Return noise, drift and Allan deviation of a displacement at rest: float64[n], n >= 16."""
    time_s = np.arange(values_um.size) / sample_rate_hz
    time_s -= time_s.mean()
    slope, mean = np.polynomial.polynomial.polyfit(time_s, values_um, 1)[::-1]
    left = values_um - mean - slope * time_s
    hz, line_um = amplitude_spectrum(left, sample_rate_hz)
    averaging_s, allan_um = allan_deviation(values_um, sample_rate_hz)
    strongest, lowest = int(np.argmax(line_um)), int(np.argmin(allan_um))
    return RestNoise(
        mean_um=float(mean),
        noise_um=float(np.std(left)),
        peak_um=float(np.abs(left).max()),
        span_um=float(np.ptp(values_um)),
        drift_um_per_s=float(slope),
        line_hz=float(hz[strongest]),
        line_um=float(line_um[strongest]),
        bias_instability_um=float(allan_um[lowest]) / _FLICKER,
        bias_time_s=float(averaging_s[lowest]),
        averaging_s=averaging_s,
        allan_um=allan_um,
    )


def _spectrum(recording: Recording, segment: Segment) -> SegmentSpectrum | None:
    samples, cycles = steady_samples(recording, segment)
    if samples.index.size < _FEWEST_SAMPLES:
        return None
    sine = segment.kind == "sine" and cycles >= _FEWEST_CYCLES
    rest = segment.kind == "hold" or not np.ptp(samples.command) > 0.0
    if not sine and not rest:
        return None
    start, stop = int(samples.index[0]), int(samples.index[-1]) + 1
    rate_hz = recording.sample_rate_hz
    _, values_um = without_gaps(replace(recording, samples=samples), start, stop)
    hz, density_um, median_um = density(values_um, rate_hz, round(_LINE_CYCLES * segment.period))
    return SegmentSpectrum(
        path=recording.path,
        label=segment.label,
        start_s=start / rate_hz,
        duration_s=(stop - start) / rate_hz,
        frequency_hz=hz,
        density_um=density_um,
        median_density_um=median_um,
        rest=rest_noise(values_um, rate_hz) if rest else None,
        sine=_harmonics(values_um, start, segment, cycles, rate_hz) if sine else None,
    )


def _harmonics(
    values_um: F64, start: int, segment: Segment, cycles: int, rate_hz: float
) -> SineHarmonics:
    since = np.arange(start, start + values_um.size) - segment.start
    count = max(1, min(_HARMONICS, math.ceil(0.5 * segment.period) - 1))
    each = 2.0 * each_cycle(since, segment.period, values_um, cycles, count)[:, 1:]
    noise_um = each.std(axis=0) / math.sqrt(max(len(each) - 1, 1))
    harmonics_um = np.abs(each.mean(axis=0))
    scale = 100.0 / max(float(harmonics_um[0]), 1e-300)
    return SineHarmonics(
        frequency_hz=rate_hz / segment.period,
        cycles=cycles,
        harmonics_um=harmonics_um,
        noise_um=noise_um,
        thd_percent=scale * float(np.linalg.norm(harmonics_um[1:])),
        thd_noise_percent=scale * float(np.linalg.norm(noise_um[1:])),
    )


def _density_text(density_um: float) -> str:
    return quantity(_NM * density_um, "nm/√Hz")


def spectrum_rows(found: SegmentSpectrum) -> Iterator[tuple[str, str]]:
    """Yield the results of a segment, each as name and text."""
    yield "evaluated", f"{quantity(found.duration_s, 's')} from {quantity(found.start_s, 's')} on"
    if (rest := found.rest) is not None:
        yield "noise", f"{quantity(rest.noise_um, 'um')} rms"
        yield "largest deviation", quantity(rest.peak_um, "um")
        yield "mean", quantity(rest.mean_um, "um", 4)
        yield "drift", quantity(_NM * rest.drift_um_per_s, "nm/s")
        line_hz = quantity(rest.line_hz, "Hz", 4)
        yield "strongest line", f"{quantity(rest.line_um, 'um')} at {line_hz}"
        most = "at most " if rest.bias_time_s == rest.averaging_s[-1] else ""
        at = quantity(rest.bias_time_s, "s")
        yield "bias instability", f"{most}{quantity(rest.bias_instability_um, 'um')} at {at}"
    if (sine := found.sine) is not None:
        yield "fundamental", f"{quantity(sine.harmonics_um[0], 'um', 4)} amplitude"
        yield "cycles", str(sine.cycles)
        noise = quantity(sine.thd_noise_percent, "%", 2)
        yield "THD", f"{quantity(sine.thd_percent, '%')} (noise alone {noise})"
        for order, amplitude_um in enumerate(sine.harmonics_um[1:4].tolist(), 2):
            yield f"harmonic {order}", quantity(amplitude_um, "um")
    yield "noise density", _density_text(found.median_density_um)
    for hz in (1.0, 10.0, 100.0, 1e3, 1e4) if found.rest else ():
        if 2.0 * found.frequency_hz[0] <= hz <= 0.5 * found.frequency_hz[-1]:
            octave = np.abs(np.log2(found.frequency_hz / hz)) < 0.5
            density_um = float(np.median(found.density_um[octave]))
            yield f"noise density at {hz:g} Hz", _density_text(density_um)


def spectrum_sheets(found: Sequence[SegmentSpectrum]) -> list[FigureSpec]:
    """Return figures of the density, the Allan deviation and the harmonics, those that apply."""
    lines = [*zip(found, _names(found), cycle(NAMED), strict=False)]

    def draw_density(axes: Axes) -> None:
        for each, name, colour in lines:
            hz, rms_um, largest_um = in_bands(each.frequency_hz, each.density_um, _BANDS)
            axes.fill_between(hz, _NM * rms_um, _NM * largest_um, color=colour, alpha=0.3)
            axes.plot(hz, _NM * rms_um, color=colour, label=name)
        _logarithmic(axes, "frequency, Hz", "density, nm/√Hz")

    def draw_allan(axes: Axes) -> None:
        for each, name, colour in lines:
            if (rest := each.rest) is not None:
                axes.plot(rest.averaging_s, _NM * rest.allan_um, color=colour, label=name)
        _logarithmic(axes, "averaging time, s", "Allan deviation, nm")

    def draw_harmonics(axes: Axes) -> None:
        for each, name, colour in lines:
            if (sine := each.sine) is not None:
                order = np.arange(1, sine.harmonics_um.size + 1)
                axes.plot(order, _NM * sine.harmonics_um, "o", color=colour, label=name)
                axes.plot(order, _NM * sine.noise_um, "_", color=colour)
        axes.set(yscale="log", xlabel="harmonic", ylabel="amplitude, nm")
        plain_numbers(axes)

    shown = (
        (True, "density", draw_density,
         "Amplitude density of the displacement; pale: largest values of each band."),
        (any(each.rest for each in found), "allan", draw_allan,
         "Allan deviation of the displacement at rest."),
        (any(each.sine for each in found), "harmonics", draw_harmonics,
         "Harmonics of the displacement (dots) and their standard errors (dashes)."),
    )  # fmt: skip
    return [
        FigureSpec(name, caption, (Panel(draw),))
        for applies, name, draw, caption in shown
        if applies
    ]


def _names(found: Sequence[SegmentSpectrum]) -> list[str]:
    """Return the labels of the segments, with the file and the time if there are several."""
    several = len({each.path for each in found}) > 1
    names = [f"{each.path.stem}: {each.label}" if several else each.label for each in found]
    if len(set(names)) < len(names):
        names = [f"{n} at {each.start_s:.6g} s" for n, each in zip(names, found, strict=True)]
    return names


def _logarithmic(axes: Axes, x: str, y: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    plain_numbers(axes)


def write_spectra(found: Sequence[SegmentSpectrum], path: Path) -> None:
    """Write the page of one or several spectra; an existing file is replaced."""
    tables = zip(_names(found), map(spectrum_rows, found), strict=True)
    terms = ["noise density"]
    terms += ["Allan deviation", "bias instability"] if any(each.rest for each in found) else []
    terms += ["THD"] if any(each.sine for each in found) else []
    body = [
        html.paragraph(", ".join(dict.fromkeys(str(each.path) for each in found)), "file"),
        *html.results(spectrum_sheets(found), "Results", list(tables)),
        html.definitions(*terms),
    ]
    write_text(path, html.document("Spectrum", body), overwrite=True)
