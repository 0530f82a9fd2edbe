"""Noise, drift and creep at rest, and the first reaction to a small sine: pure functions."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilctl.analysis.steady_state import steady_samples
from hilctl.base.types import F64, I64
from hilctl.ilc.cycle import coefficients
from hilctl.recording.recording import Recording
from hilctl.studies.characterise.rig_problem import RigProblemError

_CLEAR = 6.0  # standard errors that a reaction must stand out by
_EVEN = 2.0
_FEWEST_CYCLES = 4
_MEAN_S = 0.1
_LONG = 10  # times that: a rest that tells creep


@dataclass(frozen=True, slots=True)
class RestNoise:
    """What the sensor shows while nothing moves.

    Attributes:
        mean_um: Mean displacement.
        noise_um: rms about a straight line.
        span_um: Highest less lowest reading.
        drift_um_per_s: Slope of that line.
        line_hz: Frequency of the strongest line of the spectrum.
        line_um: Amplitude of that line.
    """

    mean_um: float
    noise_um: float
    span_um: float
    drift_um_per_s: float
    line_hz: float
    line_um: float


def rest_noise(recording: Recording) -> RestNoise:
    """Judge a recording in which the command stays where it is.

    Raises:
        RigProblemError: Most readings are no numbers.
    """
    segment = recording.segments[0]
    displacement_um = recording.samples.part(segment.start, segment.stop).displacement_um
    good = np.isfinite(displacement_um)
    if np.count_nonzero(good) < 0.9 * max(good.size, 1):
        text = f"{np.count_nonzero(~good)} of {good.size} readings at rest are no numbers"
        raise RigProblemError("no_reading", text, "look at the sensor, its range and its wires")
    time_s = np.arange(good.size)[good] / recording.sample_rate_hz
    values = displacement_um[good]
    slope, mean = np.polynomial.polynomial.polyfit(time_s - time_s.mean(), values, 1)[::-1]
    left = values - mean - slope * (time_s - time_s.mean())
    lines = np.abs(np.fft.rfft(left * np.hanning(left.size))) * 4.0 / left.size
    strongest = int(np.argmax(lines[1:])) + 1
    return RestNoise(
        mean_um=float(mean),
        noise_um=float(np.std(left)),
        span_um=float(np.ptp(values)),
        drift_um_per_s=float(slope),
        line_hz=strongest * recording.sample_rate_hz / left.size,
        line_um=float(lines[strongest]),
    )


def crept_percent(recording: Recording) -> tuple[float, ...]:
    """Return how far the displacement moves on in each long rest, in percent of where it stands.

    Each from a tenth of a second after the motion before it, and from the displacement at the
    beginning; rests where the command began are left out.
    """
    segment = recording.segments[-1]
    samples = recording.samples.part(segment.start, segment.stop)
    command, part = samples.command, round(_MEAN_S * recording.sample_rate_hz)
    began = float(recording.samples.command[0])
    began_um = float(np.nanmean(recording.samples.displacement_um[:part]))
    turns = np.flatnonzero(np.diff(command))
    edges = np.concatenate(([0], turns + 1, [command.size]))
    crept = []
    for start, stop in pairwise(edges.tolist()):
        if stop - start < _LONG * part or abs(command[start] - began) < 1e-9 * np.ptp(command):
            continue
        moving_um = samples.displacement_um[start:stop]
        first_um = float(np.nanmean(moving_um[part : 2 * part]))
        last_um = float(np.nanmean(moving_um[-part:]))
        crept.append(100.0 * (last_um - first_um) / (first_um - began_um))
    return tuple(crept)


@dataclass(frozen=True, slots=True)
class StepResponseCheck:
    """What a sine of the command does to the displacement.

    Attributes:
        frequency_hz: Its frequency.
        amplitude: Its amplitude, in the command's unit.
        gain_um: Displacement over command, um a command unit; negative where it falls as the
            command rises.
        angle_deg: Phase of the displacement behind the command, from -180 to 180.
        doubt_um: Standard error of the gain, the same unit.
        second_um: Amplitude at twice the frequency, in um.
        motion_um: Amplitude at the frequency, in um.
    """

    frequency_hz: float
    amplitude: float
    gain_um: float
    angle_deg: float
    doubt_um: float
    second_um: float
    motion_um: float

    @property
    def clear(self) -> bool:
        """Whether it stands out of the noise."""
        return abs(self.gain_um) > _CLEAR * self.doubt_um and self.gain_um != 0.0

    @property
    def even(self) -> bool:
        """Whether the displacement reacts alike to both signs of the command."""
        doubt_um = self.doubt_um * self.amplitude
        return self.second_um > max(_EVEN * self.motion_um, _CLEAR * doubt_um)


def sine_reaction(recording: Recording) -> StepResponseCheck:
    """Judge a recording of one sine by its first and second harmonic."""
    segment = recording.segments[-1]
    samples, cycles = steady_samples(recording, segment)
    since = samples.index - segment.start
    command = coefficients(since, segment.period, samples.command, 2)
    each = _each_cycle(since, segment.period, samples.displacement_um, max(cycles, 1))
    mean = each.mean(axis=0)
    error = float(np.std(np.abs(each[:, 1] - mean[1]))) if len(each) < _FEWEST_CYCLES else 0.0
    if len(each) >= _FEWEST_CYCLES:
        scatter = np.sqrt(np.mean(np.abs(each[:, 1] - mean[1]) ** 2))
        error = float(scatter / math.sqrt(len(each) - 1))
    answer = mean[1] / command[1]
    size = abs(answer)
    return StepResponseCheck(
        frequency_hz=recording.sample_rate_hz / segment.period,
        amplitude=2.0 * abs(command[1]),
        gain_um=float(math.copysign(size, answer.real)),
        angle_deg=-math.degrees(np.angle(answer)),
        doubt_um=error / abs(command[1]),
        second_um=2.0 * float(abs(mean[2])),
        motion_um=2.0 * float(abs(mean[1])),
    )


def _each_cycle(since: I64, period: float, values: F64, cycles: int) -> np.ndarray:
    """Return coefficients 0 to 2 of each whole cycle: complex128[cycles, 3], drift taken out."""
    good = np.isfinite(values)
    since, values = since[good], values[good]
    number = np.floor((since - since[-1] - 0.5) / period).astype(np.int64) + cycles
    rows = [number == k for k in range(cycles)]
    rows = [row for row in rows if row.any()]
    if len(rows) > 1:  # a line through the samples would take some of the sine with it
        means = [float(values[row].mean()) for row in rows]
        slope = np.polynomial.polynomial.polyfit(np.arange(len(rows)), means, 1)[1]
        values = values - slope * since / period
    return np.array([coefficients(since[r], period, values[r], 2) for r in rows])
