"""Error of a recording's steady cycles, per harmonic."""

import cmath
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilctl.analysis.steady_state import SteadyPart, steady_part
from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.base.types import C128, F64
from hilctl.lab.spectrum import coefficients
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics

MAX_HARMONICS = 2000
"""Most harmonics; a bin of the average cycle is then a quarter of the shortest one."""

_FEWEST_CYCLES = 2
_STRONGEST_WITHIN = 16  # harmonics of the waveform


@dataclass(frozen=True, slots=True)
class CycleScore:
    """Error of the steady cycles of one segment.

    Attributes:
        harmonics_um: complex128[K + 1], coefficients c_k of displacement less reference.
        noise_um: float64[K + 1], their standard deviations, from the scatter of the cycles.
        peak_um: Peak error of the average cycle, as in reports.
        peak_to_peak_um: Peak-to-peak of the reference.
        floor_um: Peak error that sensor noise alone would cause.
        strongest_hz: Frequency of the reference's strongest harmonic.
        answer: Displacement over reference at that frequency.
    """

    harmonics_um: C128
    noise_um: F64
    step_hz: float
    cycles: int
    peak_um: float
    rms_um: float
    peak_to_peak_um: float
    floor_um: float
    strongest_hz: float
    answer: complex

    @property
    def delay_s(self) -> float:
        """Delay of the displacement, from the phase of the strongest harmonic."""
        return -cmath.phase(self.answer) / (2.0 * math.pi * self.strongest_hz)

    @property
    def percent(self) -> float:
        """Peak error in percent of the reference's peak-to-peak."""
        return 100.0 * self.peak_um / self.peak_to_peak_um

    @property
    def floor_percent(self) -> float:
        """Noise floor of :attr:`percent`."""
        return 100.0 * self.floor_um / self.peak_to_peak_um


def cycle_error(
    recording: Recording, segment: Segment, highest_hz: float, waveform_cycles: int = 1
) -> CycleScore:
    """Return the error of a segment; raise DataError without motion or two whole steady cycles.

    A cycle of the error contains that many cycles of the segment's waveform.
    """
    segment = replace(segment, period=waveform_cycles * segment.period)
    part = steady_part(recording, segment)
    if part.cycles < _FEWEST_CYCLES:
        rule = f"{segment.label}: needs at least {_FEWEST_CYCLES} whole steady cycles"
        raise DataError(f"{recording.path}: {rule}, got {part.cycles}")
    if part.cycle is None:
        raise DataError(f"{recording.path}: {segment.label}: samples are missing in every cycle")
    reference, displacement = part.cycle.signals
    whole = cycle_metrics.peak_to_peak(reference)
    if not (whole > 0.0 and np.ptp(displacement) > 0.0):
        raise DataError(f"{recording.path}: {segment.label}: nothing moved")
    step_hz = recording.sample_rate_hz / segment.period
    count = harmonic_count(segment.period, step_hz, highest_hz)
    each = _each_cycle(recording.path, part, segment, count)
    strongest_hz, answer = _answer(part, segment, step_hz, waveform_cycles)
    return CycleScore(
        harmonics_um=each.mean(axis=0),
        noise_um=_scatter_um(each),
        step_hz=step_hz,
        cycles=part.cycles,
        peak_um=cycle_metrics.peak(displacement - reference),
        rms_um=cycle_metrics.rms(displacement - reference),
        peak_to_peak_um=whole,
        floor_um=_floor_um(part, segment.period),
        strongest_hz=strongest_hz,
        answer=answer,
    )


def harmonic_count(period: float, step_hz: float, highest_hz: float) -> int:
    """Return the number of harmonics of a period, in samples, up to a frequency."""
    return max(1, min(int(period / 4.0), int(highest_hz / step_hz), MAX_HARMONICS))


def _each_cycle(path: Path, part: SteadyPart, segment: Segment, count: int) -> C128:
    """Return the coefficients of the error in each cycle: complex128[cycles, count + 1], in um."""
    samples = part.samples
    since = samples.index - segment.start
    error = samples.displacement_um - samples.reference_um
    number = np.floor((since - since[-1] - 0.5) / segment.period).astype(np.int64) + part.cycles
    rows = [number == k for k in range(part.cycles)]
    whole = [row for row in rows if np.count_nonzero(row) > 0.95 * segment.period]
    if len(whole) < _FEWEST_CYCLES:
        raise DataError(f"{path}: {segment.label}: samples are missing in nearly every cycle")
    return np.array([coefficients(since[r], segment.period, error[r], count) for r in whole])


def _scatter_um(each: C128) -> F64:
    """Return the standard deviation of the mean of cycles, complex128[cycles, n]: float64[n].

    Second differences, and their median, contain no drift or creep within a run. It repeats in the
    next run, and can be learned.
    """
    order = min(2, len(each) - 1)
    change = np.median(np.abs(np.diff(each, order, axis=0)) ** 2, axis=0)
    variance = change / (math.log(2.0) * math.comb(2 * order, order))  # of an exponential law
    scatter: F64 = np.sqrt(variance / len(each))
    return scatter


def _answer(
    part: SteadyPart, segment: Segment, step_hz: float, waveform_cycles: int
) -> tuple[float, complex]:
    """Return the frequency of the reference's strongest harmonic, and its response."""
    samples = part.samples
    highest_hz = _STRONGEST_WITHIN * waveform_cycles * step_hz
    count = harmonic_count(segment.period, step_hz, highest_hz)
    since = samples.index - segment.start
    wanted = coefficients(since, segment.period, samples.reference_um, count)
    moved = coefficients(since, segment.period, samples.displacement_um, count)
    k = int(np.argmax(np.abs(wanted[1:]))) + 1
    return k * step_hz, complex(moved[k] / wanted[k])


def _floor_um(part: SteadyPart, period: float) -> float:
    assert part.cycle is not None
    samples, counts = part.samples, part.cycle.counts
    if period < cycle_metrics.SHORTEST_PERIOD:
        return 0.0
    noise_um = cycle_metrics.sensor_noise_um(samples.index, samples.displacement_um) or 0.0
    average_um = noise_um * float(np.sqrt(np.mean(1.0 / counts)))
    return average_um * cycle_metrics.expected_maximum(counts.size)
