"""Small-signal response: measured line by line, and gain, delay, lag and resonance that explain it.

The displacement answers a multisine of small amplitude. The scatter from period to period is the
noise of each line.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from hilctl.base.errors import DataError
from hilctl.base.types import C128, F64
from hilctl.recording.recording import Recording
from hilctl.studies.characterise.rig_problem import RigProblemError

MOST_MISSING = 0.01
"""Largest part of the samples that may be missing; a run that skips more ends by itself."""


def without_gaps(recording: Recording, start: int, stop: int) -> tuple[F64, F64]:
    """Return every command and displacement between two samples, those skipped included.

    Args:
        recording: A run.
        start: Index of the first sample.
        stop: Index after the last.

    Returns:
        Command, held where samples are missing, and displacement in um, straight lines there:
        float64[stop - start] each.

    Raises:
        DataError: More than 1 % of them are missing or have no displacement.
    """
    samples = recording.samples.part(start, stop)
    wanted = np.arange(start, stop)
    good = np.isfinite(samples.displacement_um)
    missing = wanted.size - np.count_nonzero(good)
    if missing > MOST_MISSING * wanted.size:
        rule = f"{missing} of {wanted.size} samples are missing or have no displacement"
        raise DataError(f"{recording.path}: {rule}: look at late ticks and at the sensor")
    last = np.maximum(np.searchsorted(samples.index, wanted, side="right") - 1, 0)
    displacement_um = np.interp(wanted, samples.index[good], samples.displacement_um[good])
    return np.ascontiguousarray(samples.command[last]), displacement_um


_FEWEST_LINES = 8
_USABLE = 0.3  # largest relative noise of a line that is fitted
_HYSTERESIS = 0.03  # of a line, which no linear response explains
_WORTH = 0.5  # of the misfit that a resonance must explain
_MOST_DAMPING = 0.8

_LOG_LOW = math.log(1e-9)


@dataclass(frozen=True, slots=True)
class SmallSignal:
    """Small-signal response.

    Attributes:
        frequency_hz: float64[k], the lines.
        response: complex128[k], displacement over command, um a command unit.
        noise: float64[k], standard deviation of each.
        amplitude: Peak of the multisine.
        gain_um: Gain at low frequencies, um a command unit.
        delay_s: Transport delay, half a sample of the output's hold included.
        lag_s: Time constant of a first-order lag; 0 where there is none.
        natural_hz: Natural frequency; None where no resonance shows.
        damping_ratio: Its damping; None without.
        misfit_percent: rms of what the fit leaves of the lines, of the gain.
        fitted: complex128[k], what the fit makes of the lines.
    """

    frequency_hz: F64
    response: C128
    noise: F64
    amplitude: float
    gain_um: float
    delay_s: float
    lag_s: float
    natural_hz: float | None
    damping_ratio: float | None
    misfit_percent: float
    fitted: C128

    def size_at(self, frequency_hz: float) -> float:
        """Return the magnitude of the fitted response at a frequency, over that at the lowest."""
        size = np.abs(self.fitted)
        return float(np.interp(frequency_hz, self.frequency_hz, size) / size[0])


def small_signal(recording: Recording) -> SmallSignal:
    """Judge a recording of one multisine whose period is whole samples.

    Raises:
        RigProblemError: Too few lines stand out of the noise.
    """
    frequency_hz, response, noise, amplitude = _lines(recording)
    usable = noise < _USABLE * np.abs(response)
    if np.count_nonzero(usable) < _FEWEST_LINES:
        text = f"only {np.count_nonzero(usable)} of {usable.size} frequencies show above the noise"
        remedy = "find out what else moves the sensor, or widen the limits: the campaign scales"
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
    shape = (periods, period)
    # Drift from period to period: a line through the samples would take low frequencies with it.
    means = moved.reshape(shape).mean(axis=1)
    slope = np.polynomial.polynomial.polyfit(np.arange(periods), means, 1)[1]
    moved = moved - slope * np.arange(moved.size) / period
    wanted = np.fft.rfft(command.reshape(shape)).mean(axis=0)
    each = np.fft.rfft(moved.reshape(shape))
    strong = np.abs(wanted) > 0.2 * np.max(np.abs(wanted[1:]))
    strong[0] = False
    k = np.flatnonzero(strong)
    scatter = np.sqrt(np.mean(np.abs(each - each.mean(axis=0)) ** 2, axis=0) / (periods - 1))
    size = np.abs(wanted[k])
    return (
        k * recording.sample_rate_hz / period,
        each.mean(axis=0)[k] / wanted[k],
        scatter[k] / size,
        0.5 * float(np.ptp(command)),
    )


def _response(x: F64, frequency_hz: F64, *, resonant: bool) -> C128:
    """Return gain, delay, lag and, where there is one, resonance: complex128[k]."""
    s = 2j * np.pi * frequency_hz
    answer: C128 = np.exp(x[0] - s * x[1]) / (1.0 + s * np.exp(x[2]))
    if resonant:
        part = 1j * frequency_hz / np.exp(x[3])
        answer = answer / (1.0 + 2.0 * np.exp(x[4]) * part + part**2)
    return answer


def _fit(frequency_hz: F64, response: C128, noise: F64, rate_hz: float) -> tuple[F64, bool]:
    """Return the parameters, and whether a resonance is among them."""
    plain = _best(frequency_hz, response, noise, rate_hz, [None])
    tries = np.geomspace(2.0 * frequency_hz[0], frequency_hz[-1], 6)
    resonant = _best(frequency_hz, response, noise, rate_hz, list(tries))
    worth = resonant.cost < _WORTH * plain.cost
    if worth and math.exp(resonant.x[4]) < _MOST_DAMPING:
        return resonant.x, True
    return plain.x, False


def _best(
    frequency_hz: F64,
    response: C128,
    noise: F64,
    rate_hz: float,
    tries: list[float] | list[None],
) -> OptimizeResult:
    """Fit from several starts; a start of None has no resonance."""
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
