"""Noise at rest, first reaction and small-signal response; problems of the rig."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from hilctl.analysis.response.frequency_response import (
    FrequencyResponse,
    NoisyResponseError,
    frequency_response,
)
from hilctl.analysis.response.segment_spectrum import RestNoise, spectra
from hilctl.analysis.steady_state import steady_samples
from hilctl.base.errors import DataError, RunError
from hilctl.recording.recording import Recording
from hilctl.signals.spectrum import coefficients, each_cycle

ProblemCode: TypeAlias = Literal[
    "no_reading",
    "no_reaction",
    "wrong_polarity",
    "no_bias",
    "noise",
    "saturated_sensor",
    "resonance",
    "not_repeatable",
    "no_model",
]


class RigProblemError(RunError):
    """A problem of the rig that prevents its characterisation: code, observation and remedy."""

    def __init__(self, code: ProblemCode, text: str, remedy: str) -> None:
        super().__init__(f"{text}: {remedy}")
        self.code = code


_CLEAR = 6.0  # standard errors of a clear reaction
_EVEN = 2.0
_FEWEST_CYCLES = 4
_MEAN_S = 0.1
_LONG = 10  # times that: shortest hold for creep


def noise_at_rest(recording: Recording) -> RestNoise | None:
    """Evaluate a recording at constant command; raise RigProblemError without enough readings."""
    try:
        return spectra(recording)[0].rest
    except DataError as error:
        remedy = "check the sensor, its range and its wiring"
        raise RigProblemError("no_reading", str(error), remedy) from None


def crept_percent(recording: Recording) -> tuple[float, ...]:
    """Return the creep from 0.1 s on in each long hold, in percent of the motion to it."""
    segment = recording.segments[-1]
    samples = recording.samples.part(segment.start, segment.stop)
    command, part = samples.command, round(_MEAN_S * recording.sample_rate_hz)
    began = float(recording.samples.command[0])
    before_um = float(np.nanmean(recording.samples.displacement_um[:part]))
    turns = np.flatnonzero(np.diff(command))
    edges = np.concatenate(([0], turns + 1, [command.size]))
    crept = []
    for start, stop in pairwise(edges.tolist()):
        if stop - start < _LONG * part or abs(command[start] - began) < 1e-9 * np.ptp(command):
            continue
        moving_um = samples.displacement_um[start:stop]
        first_um = float(np.nanmean(moving_um[part : 2 * part]))
        last_um = float(np.nanmean(moving_um[-part:]))
        crept.append(100.0 * (last_um - first_um) / (first_um - before_um))
        before_um = last_um
    return tuple(crept)


@dataclass(frozen=True, slots=True)
class StepResponseCheck:
    """Response of the displacement to a sine."""

    frequency_hz: float
    amplitude: float  # amplitude of the sine, in the command's unit
    gain_um: float  # per command unit; negative if the displacement falls as the command rises
    angle_deg: float  # phase lag of the displacement, from -180 to 180
    doubt_um: float  # standard error of the gain, in the same unit
    second_um: float  # amplitude at twice the frequency, in um
    motion_um: float  # amplitude at the frequency, in um

    @property
    def clear(self) -> bool:
        """Whether it is above the noise."""
        return abs(self.gain_um) > _CLEAR * self.doubt_um and self.gain_um != 0.0

    @property
    def even(self) -> bool:
        """Whether the displacement responds alike to both signs of the command."""
        doubt_um = self.doubt_um * self.amplitude
        return self.second_um > max(_EVEN * self.motion_um, _CLEAR * doubt_um)


def sine_reaction(recording: Recording) -> StepResponseCheck:
    """Evaluate a recording of one sine by its first and second harmonic."""
    segment = recording.segments[-1]
    samples, cycles = steady_samples(recording, segment)
    since = samples.index - segment.start
    command = coefficients(since, segment.period, samples.command, 2)
    each = each_cycle(since, segment.period, samples.displacement_um, max(cycles, 1))
    mean = each.mean(axis=0)
    off = np.abs(each[:, 1] - mean[1])
    few = len(each) < _FEWEST_CYCLES
    error = float(np.std(off) if few else np.sqrt(np.mean(off**2) / (len(each) - 1)))
    answer = mean[1] / command[1]
    return StepResponseCheck(
        frequency_hz=recording.sample_rate_hz / segment.period,
        amplitude=2.0 * abs(command[1]),
        gain_um=float(math.copysign(abs(answer), answer.real)),
        angle_deg=-math.degrees(np.angle(answer)),
        doubt_um=error / abs(command[1]),
        second_um=2.0 * float(abs(mean[2])),
        motion_um=2.0 * float(abs(mean[1])),
    )


def small_signal(recording: Recording) -> FrequencyResponse:
    """Evaluate one multisine; raise RigProblemError if too few lines are above the noise."""
    try:
        return frequency_response(recording)
    except NoisyResponseError as error:
        remedy = "find what else moves the sensor, or widen the limits"
        raise RigProblemError("noise", f"small-signal response: {error}", remedy) from None
    except DataError as error:
        raise RigProblemError("no_reading", str(error), "then run it again") from None
