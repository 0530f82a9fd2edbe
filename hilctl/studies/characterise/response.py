"""Noise at rest, first reaction and small-signal response; problems of the rig."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from hilctl.analysis.steady_state import steady_samples
from hilctl.base.errors import DataError, RunError
from hilctl.base.types import C128, F64, I64
from hilctl.identify.data.data_files import without_gaps
from hilctl.ilc.cycle import coefficients
from hilctl.models.linear_stages import FirstMode
from hilctl.recording.recording import Recording

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
_FEWEST_LINES = 8
_USABLE = 0.3  # largest relative noise of a line that is fitted
_HYSTERESIS = 0.03  # of a line, that no linear response explains
_WORTH = 0.5  # of the misfit that a resonance must explain
_MOST_DAMPING = 0.8
_LOG_LOW = math.log(1e-9)


@dataclass(frozen=True, slots=True)
class RestNoise:
    """Sensor signal at rest."""

    mean_um: float
    noise_um: float  # rms about the linear trend
    span_um: float  # range of the readings
    drift_um_per_s: float  # slope of the linear trend
    line_hz: float  # frequency of the strongest spectral line
    line_um: float  # its amplitude


def rest_noise(recording: Recording) -> RestNoise:
    """Evaluate a recording at constant command; at least 90 % of its readings are numbers."""
    segment = recording.segments[0]
    displacement_um = recording.samples.part(segment.start, segment.stop).displacement_um
    good = np.isfinite(displacement_um)
    if np.count_nonzero(good) < 0.9 * max(good.size, 1):
        text = f"{np.count_nonzero(~good)} of {good.size} readings at rest are not numbers"
        raise RigProblemError("no_reading", text, "check the sensor, its range and its wiring")
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
    each = _each_cycle(since, segment.period, samples.displacement_um, max(cycles, 1))
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


def _each_cycle(since: I64, period: float, values: F64, cycles: int) -> np.ndarray:
    """Return coefficients 0 to 2 of each whole cycle without drift: complex128[cycles, 3]."""
    good = np.isfinite(values)
    since, values = since[good], values[good]
    number = np.floor((since - since[-1] - 0.5) / period).astype(np.int64) + cycles
    rows = [row for k in range(cycles) if (row := number == k).any()]
    if len(rows) > 1:  # a line through the samples would remove part of the sine
        means = [float(values[row].mean()) for row in rows]
        slope = np.polynomial.polynomial.polyfit(np.arange(len(rows)), means, 1)[1]
        values = values - slope * since / period
    return np.array([coefficients(since[r], period, values[r], 2) for r in rows])


@dataclass(frozen=True, slots=True)
class SmallSignal:
    """Small-signal response."""

    frequency_hz: F64  # float64[k], the lines
    response: C128  # complex128[k], displacement over command, um per command unit
    noise: F64  # float64[k], standard deviation of each
    amplitude: float  # peak of the multisine
    gain_um: float  # gain at low frequencies, um per command unit
    delay_s: float  # transport delay, including the half sample of the output's hold
    lag_s: float  # time constant of a first-order lag; 0 for none
    natural_hz: float | None  # natural frequency; None without a resonance
    damping_ratio: float | None  # its damping ratio; None without a resonance
    misfit_percent: float  # rms residual of the fit, of the gain
    fitted: C128  # complex128[k], the fitted response

    @property
    def structure(self) -> FirstMode | None:
        """The resonance as a stage of a model; None without one."""
        if self.natural_hz is None or self.damping_ratio is None:
            return None
        return FirstMode(natural_hz=self.natural_hz, damping_ratio=self.damping_ratio)

    def size_at(self, frequency_hz: float) -> float:
        """Return the fitted magnitude at a frequency, over that at the lowest line."""
        size = np.abs(self.fitted)
        return float(np.interp(frequency_hz, self.frequency_hz, size) / size[0])


def small_signal(recording: Recording) -> SmallSignal:
    """Evaluate one multisine; raise RigProblemError if too few lines are above the noise."""
    frequency_hz, response, noise, amplitude = _lines(recording)
    usable = noise < _USABLE * np.abs(response)
    if np.count_nonzero(usable) < _FEWEST_LINES:
        text = f"only {np.count_nonzero(usable)} of {usable.size} frequencies are above the noise"
        remedy = "find what else moves the sensor, or widen the limits"
        raise RigProblemError("noise", f"small-signal response: {text}", remedy)
    frequency_hz, response, noise = frequency_hz[usable], response[usable], noise[usable]
    found, resonant = _fit(frequency_hz, response, noise, recording.sample_rate_hz)
    fitted = _response(found, frequency_hz, resonant=resonant)
    left = np.abs(fitted - response) / math.exp(found[0])
    lag_s = math.exp(found[2])
    return SmallSignal(
        frequency_hz=frequency_hz,
        response=response,
        noise=noise,
        amplitude=amplitude,
        gain_um=math.exp(found[0]),
        delay_s=float(found[1]),
        lag_s=lag_s if lag_s * frequency_hz[-1] > 1e-3 else 0.0,
        natural_hz=math.exp(found[3]) if resonant else None,
        damping_ratio=math.exp(found[4]) if resonant else None,
        misfit_percent=100.0 * float(np.sqrt(np.mean(left**2))),
        fitted=fitted,
    )


def _lines(recording: Recording) -> tuple[F64, C128, F64, float]:
    """Return frequencies, response, its noise, and the multisine's peak."""
    segment = recording.segments[-1]
    period = round(segment.period)
    periods = (segment.steady_stop - segment.steady_start) // period - 1
    stop = segment.steady_stop
    try:
        command, moved = without_gaps(recording, stop - periods * period, stop)
    except DataError as error:
        raise RigProblemError("no_reading", str(error), "then run it again") from None
    shape = periods, period
    # Drift between periods: a line through the samples would remove low frequencies.
    means = moved.reshape(shape).mean(axis=1)
    slope = np.polynomial.polynomial.polyfit(np.arange(periods), means, 1)[1]
    moved = moved - slope * np.arange(moved.size) / period
    wanted = np.fft.rfft(command.reshape(shape)).mean(axis=0)
    each = np.fft.rfft(moved.reshape(shape))
    strong = np.abs(wanted) > 0.2 * np.max(np.abs(wanted[1:]))
    strong[0] = False
    k = np.flatnonzero(strong)
    scatter = np.sqrt(np.mean(np.abs(each - each.mean(axis=0)) ** 2, axis=0) / (periods - 1))
    response, noise = each.mean(axis=0)[k] / wanted[k], scatter[k] / np.abs(wanted[k])
    return k * recording.sample_rate_hz / period, response, noise, 0.5 * float(np.ptp(command))


def _response(x: F64, frequency_hz: F64, *, resonant: bool) -> C128:
    """Return the response of gain, delay, lag and optional resonance: complex128[k]."""
    s = 2j * np.pi * frequency_hz
    answer: C128 = np.exp(x[0] - s * x[1]) / (1.0 + s * np.exp(x[2]))
    if resonant:
        part = 1j * frequency_hz / np.exp(x[3])
        answer = answer / (1.0 + 2.0 * np.exp(x[4]) * part + part**2)
    return answer


def _fit(frequency_hz: F64, response: C128, noise: F64, rate_hz: float) -> tuple[F64, bool]:
    """Return the parameters, and whether they include a resonance."""
    plain = _best(frequency_hz, response, noise, rate_hz, [None])
    tries = np.geomspace(2.0 * frequency_hz[0], frequency_hz[-1], 6)
    resonant = _best(frequency_hz, response, noise, rate_hz, list(tries))
    worth = resonant.cost < _WORTH * plain.cost
    if worth and math.exp(resonant.x[4]) < _MOST_DAMPING:
        return resonant.x, True
    return plain.x, False


def _best(
    frequency_hz: F64, response: C128, noise: F64, rate_hz: float, tries: list[float] | list[None]
) -> OptimizeResult:
    """Return the best fit from several starting frequencies; None fits no resonance."""
    doubt = np.hypot(noise, _HYSTERESIS * np.abs(response))
    top = float(frequency_hz[-1])

    def fitted(start_hz: float | None) -> OptimizeResult:
        def residuals(x: F64) -> F64:
            off = (_response(x, frequency_hz, resonant=start_hz is not None) - response) / doubt
            return np.concatenate((off.real, off.imag))

        slope = np.polynomial.polynomial.polyfit(frequency_hz, np.unwrap(np.angle(response)), 1)[1]
        delay_s = min(max(-slope / (2.0 * np.pi), 0.5 / rate_hz), 100.0 / rate_hz)
        start = [math.log(abs(response[0])), 0.5 * delay_s, math.log(0.02 / top)]
        low, high = [-30.0, -1.0 / rate_hz, _LOG_LOW], [30.0, 1e4 / rate_hz, math.log(1e3 / top)]
        if start_hz is not None:
            start += [math.log(start_hz), math.log(0.1)]
            low += [math.log(0.5 * frequency_hz[0]), math.log(1e-4)]
            high += [math.log(1.5 * top), math.log(5.0)]
        return least_squares(residuals, start, bounds=(low, high), loss="soft_l1", x_scale="jac")

    return min((fitted(each) for each in tries), key=lambda each: float(each.cost))
