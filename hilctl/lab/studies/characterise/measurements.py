"""Evaluation of the recording of a step: noise, reaction, response, loops, reversal curves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from hilctl.analysis.steady_state import steady_part, steady_samples
from hilctl.base.errors import DataError, RunError
from hilctl.base.segments import Segment
from hilctl.base.types import C128, F64
from hilctl.lab.response.frequency_response import (
    FrequencyResponse,
    NoisyResponseError,
    frequency_response,
)
from hilctl.lab.response.segment_spectrum import RestNoise, spectra
from hilctl.lab.spectrum import coefficients, each_cycle
from hilctl.models.linear_stages import Compliance
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics

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
_LONG = 10  # shortest hold for creep, over _MEAN_S


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
        """Whether the part in phase, which has a sign, is above the noise.

        A stage held by friction creeps by less than its noise, a quarter of a cycle late.
        """
        in_phase_um = self.gain_um * abs(math.cos(math.radians(self.angle_deg)))
        return abs(in_phase_um) > _CLEAR * self.doubt_um and self.gain_um != 0.0

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
        remedy = "find other causes of motion at the sensor, or widen the limits"
        raise RigProblemError("noise", f"small-signal response: {error}", remedy) from None
    except DataError as error:
        remedy = "on a busy computer, lower sample_rate_hz"
        raise RigProblemError("no_reading", str(error), remedy) from None


_UNCLEAR_PERCENT = 50.0  # residual of a response, of its gain, that has other modes than its fit


@dataclass(frozen=True, slots=True)
class LocalResonance:
    """The resonance at a place of the stroke."""

    place_um: float  # mean displacement
    natural_hz: float
    error_hz: float  # standard error


def local_resonances(recording: Recording, found: FrequencyResponse) -> tuple[LocalResonance, ...]:
    """Return the resonance of a response with its place; empty if none is clear."""
    if found.natural_hz is None or found.misfit_percent > _UNCLEAR_PERCENT:
        return ()
    samples, _ = steady_samples(recording, recording.segments[-1])
    place_um = float(np.nanmean(samples.displacement_um))
    return (LocalResonance(place_um, found.natural_hz, found.errors["natural_hz"]),)


_CHANGED = 0.03  # change of the frequency that counts; less moves a sixth of it by 0.2 %
_CERTAIN = 4.0  # the same, of its standard error
_CELLS = 16


def compliance_of(
    places: Sequence[LocalResonance], stroke_um: tuple[float, float]
) -> Compliance | None:
    """Return the compliance over a stroke relative to the first place; None if it is the same."""
    first_hz, error_hz = places[0].natural_hz, places[0].error_hz
    if all(
        abs(at.natural_hz - first_hz)
        <= max(_CHANGED * first_hz, _CERTAIN * math.hypot(error_hz, at.error_hz))
        for at in places
    ):
        return None
    known = np.array(sorted((at.place_um, (first_hz / at.natural_hz) ** 2) for at in places)).T
    at_um = np.linspace(*stroke_um, _CELLS + 1)
    relative = np.interp(at_um, *known)
    return Compliance(
        lowest_um=stroke_um[0],
        cell_um=(stroke_um[1] - stroke_um[0]) / _CELLS,
        relative=tuple(relative.tolist()),
    )


_FEWEST_STEPS = 500  # distinct readings in a motion, for equal readings to mean saturation
_AT_END = 0.06  # share of a cycle at the same extreme reading
_OF_STROKE = 0.9  # small loops near an end rise above the largest loop, by 7 % of its stroke
_FIRST_GROWTH = 1.5  # exponent of displacement over amplitude, until it is known
_MORE_GROWTH = 0.2
_LEAST_RATIO = 0.01
_WORTHWHILE = 1.03
_NEAR_TOP = 0.004
_POINTS = 400
_SHAPE_HARMONICS = 12


@dataclass(frozen=True, slots=True)
class LoopMetrics:
    """One steady loop."""

    label: str  # label of the segment
    amplitude: float  # half the peak-to-peak command
    bias: float  # mid-range of the command
    frequency_hz: float
    low_um: float  # lowest displacement of the average cycle
    high_um: float  # highest
    hysteresis_percent: float | None  # peak hysteresis; None if the loop has no two branches
    scatter_percent: float  # rms difference of a cycle from the next, of the peak-to-peak
    command: F64  # float64[m], the average cycle's command
    displacement_um: F64  # float64[m], its displacement

    @property
    def peak_to_peak_um(self) -> float:
        """Peak-to-peak displacement."""
        return self.high_um - self.low_um

    @property
    def gain_um(self) -> float:
        """Peak-to-peak displacement over peak-to-peak command, um per command unit."""
        return 0.5 * self.peak_to_peak_um / self.amplitude


def loop_metrics(recording: Recording, segment: Segment) -> LoopMetrics:
    """Evaluate the steady cycles of a segment; raise DataError without a whole one."""
    part = steady_part(recording, segment)
    if part.cycle is None:
        raise DataError(f"{recording.path}: {segment.label}: no whole steady cycle")
    _refuse_saturated(part.samples.displacement_um, segment.label)
    command, displacement_um = part.cycle.signals
    low_um, high_um = float(displacement_um.min()), float(displacement_um.max())
    since = part.samples.index - segment.start
    each = each_cycle(since, segment.period, part.samples.displacement_um, max(part.cycles, 1))
    return LoopMetrics(
        label=segment.label,
        amplitude=0.5 * float(np.ptp(command)),
        bias=0.5 * float(command.max() + command.min()),
        frequency_hz=recording.sample_rate_hz / segment.period,
        low_um=low_um,
        high_um=high_um,
        hysteresis_percent=cycle_metrics.peak_hysteresis_percent(command, displacement_um),
        scatter_percent=100.0 * _scatter_um(each) / max(high_um - low_um, 1e-12),
        command=command,
        displacement_um=displacement_um,
    )


def _scatter_um(cycles: C128) -> float:
    """Return the rms difference of a cycle from the next in the second half, over sqrt(2).

    ``cycles`` are the Fourier coefficients of each, complex128[cycles, k]. The first cycles of a
    sound actuator differ too: after a motion the mean of small ones creeps and accommodates.
    """
    steps = np.diff(cycles[len(cycles) // 2 :], axis=0)
    power_um2 = np.abs(steps[:, 0]) ** 2 + 2.0 * np.sum(np.abs(steps[:, 1:]) ** 2, axis=1)
    return float(np.sqrt(0.5 * power_um2.mean())) if len(steps) else 0.0


def centre_line(loop: LoopMetrics) -> F64:
    """Return the mean command of both branches at even steps of the displacement: float64[k]."""
    first = int(loop.displacement_um.argmin())
    command, y = np.roll(loop.command, -first), np.roll(loop.displacement_um, -first)
    turn = int(y.argmax())
    steps = np.linspace(y[0], y[turn], _POINTS)
    rising, falling = (
        np.interp(steps, np.maximum.accumulate(y[branch]), command[branch])
        for branch in (slice(0, turn + 1), slice(None, turn - 1, -1))
    )
    return np.asarray(0.5 * (rising + falling))


def all_loops(recording: Recording) -> tuple[LoopMetrics, ...]:
    """Evaluate every periodic segment."""
    return tuple(loop_metrics(recording, each) for each in recording.segments if each.period > 0.0)


def _refuse_saturated(displacement_um: F64, label: str) -> None:
    values = displacement_um[np.isfinite(displacement_um)]
    if np.unique(values).size < _FEWEST_STEPS:
        return
    for end in (values.min(), values.max()):
        share = float(np.mean(values == end))
        if share > _AT_END:
            raise RigProblemError(
                "saturated_sensor",
                f"{label}: the sensor reads {end:.4g} µm for {100.0 * share:.0f} % of the time",
                "move the sensor, set a wider range, or narrow limits.stroke_um below that",
            )


def next_amplitude(
    loops: Sequence[LoopMetrics], wanted: float, stroke_um: tuple[float, float]
) -> float | None:
    """Return the wanted amplitude, lowered to the stroke; None if it is hardly a change."""
    # Displacement grows faster than the command: the last two loops give the exponent.
    if not loops:
        return wanted
    last = loops[-1]
    exponent = _FIRST_GROWTH
    ratio = math.log(last.amplitude / loops[-2].amplitude) if len(loops) > 1 else 0.0
    if ratio > _LEAST_RATIO:
        before = loops[-2]
        grown = math.log(max(last.peak_to_peak_um / max(before.peak_to_peak_um, 1e-12), 1e-6))
        exponent = min(max(grown / ratio, 0.5), 3.0) + _MORE_GROWTH
    middle_um = 0.5 * (last.high_um + last.low_um)
    half_um = max(0.5 * last.peak_to_peak_um, 1e-12)
    centre_um, room_um = 0.5 * sum(stroke_um), 0.5 * _OF_STROKE * (stroke_um[1] - stroke_um[0])
    free_um = room_um - abs(middle_um - centre_um)
    if free_um <= half_um:
        return None
    allowed = last.amplitude * float((free_um / half_um) ** (1.0 / exponent))
    chosen = min(wanted, allowed)
    return chosen if chosen > _WORTHWHILE * last.amplitude else None


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Change of a loop that is measured twice."""

    shape_percent: float  # largest difference without the means, of the peak-to-peak
    shift_um: float  # change of the mean
    shift_percent: float  # the same, of the peak-to-peak


def repeatability(first: LoopMetrics, again: LoopMetrics) -> Repeatability:
    """Compare two measurements of one loop."""
    phase = np.linspace(0.0, 1.0, _POINTS, endpoint=False)
    one, two = (
        np.interp(phase, np.arange(y.size) / y.size, y, period=1.0)
        for y in (first.displacement_um, again.displacement_um)
    )
    shift_um = float(two.mean() - one.mean())
    whole = max(first.peak_to_peak_um, 1e-12)
    # Sensor noise spreads over all harmonics, a change of shape over the lowest.
    harmonics = np.fft.rfft(two - one - shift_um)
    harmonics[_SHAPE_HARMONICS + 1 :] = 0.0
    shape = float(np.max(np.abs(np.fft.irfft(harmonics, _POINTS))))
    return Repeatability(100.0 * shape / whole, shift_um, 100.0 * abs(shift_um) / whole)


@dataclass(frozen=True, slots=True)
class ReversalCurves:
    """First-order reversal curves."""

    turns: tuple[float, ...]  # commands of the turning points, the highest first
    curves: tuple[F64, ...]  # command and displacement from the turn to the top, float64[2, n]
    return_um: float  # rms difference at the top between curves; nan if no sample is near it
    return_percent: float  # the same, of the span of the curves


def reversal_curves(recording: Recording) -> ReversalCurves:
    """Split a path of reversal curves at its turning points."""
    segment = recording.segments[-1]
    samples = recording.samples.part(segment.start, segment.stop)
    command, displacement_um = samples.command, samples.displacement_um
    moving = np.flatnonzero(np.diff(command))  # a corner may be two samples wide
    edges = moving[1:][np.diff(np.sign(command[moving + 1] - command[moving])) != 0.0]
    # The first three turns are the outer loop: top, bottom, top.
    pairs = list(zip(edges[1::2].tolist(), edges[2::2].tolist(), strict=False))
    curves = [np.array((command[a : b + 1], displacement_um[a : b + 1])) for a, b in pairs]
    top, span = float(command.max()), float(np.ptp(command))
    near_top = [c[1][c[0] > top - _NEAR_TOP * span] for c in curves]
    ends = [np.nanmean(each) if each.size else math.nan for each in near_top]
    span_um = max(float(np.nanmax(displacement_um) - np.nanmin(displacement_um)), 1e-12)
    spread_um = float(np.std(ends))
    return ReversalCurves(
        turns=tuple(float(c[0][0]) for c in curves),
        curves=tuple(curves),
        return_um=spread_um,
        return_percent=100.0 * spread_um / span_um,
    )
