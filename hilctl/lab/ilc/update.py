"""Update of the correction from the errors so far: pure functions of frozen state.

Each update starts from the combination of the runs so far with the smallest error, and subtracts
the error of each harmonic, filtered by the inverse of the identified response. The bandwidth grows
while the error falls. If the error grows, the next step starts from the best correction, with half
the gain and a smaller bandwidth.

The errors of axes that move at the same time depend on each other. Their learners learn from the
same runs, and end together, with the corrections of one run.

With a nearly exact compensator the response is close to a delay of some samples. The remaining
resonance of the structure limits the bandwidth of a correction. The response is therefore a gain, a
delay and one second-order resonance, fitted to the changes of each harmonic. If a harmonic has
changed significantly, its measured response corrects the fit, which lacks further resonances.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.types import C128, F64
from hilctl.lab.ilc.cycle import CycleScore

_COUPLING = 0.15
"""Share of a harmonic's change that hysteresis couples into its neighbours."""

_CLEAR = 4.0
_FIRST_DOUBT = 0.05
_FIT_DOUBT = 0.3
"""Standard deviation of the fitted response at a harmonic, as a share of it."""

_CHANGE_DOUBT = 0.1
"""Standard deviation of the effect of a change if others are added to it, as a share of it."""

# Parameters: log gain, delay in samples, (highest / natural frequency)^2, log damping ratio.
_BELIEVED = np.array([0.0, 1.0, 0.0, math.log(0.2)])
_DOUBT = np.array([0.2, 10.0, 0.7, 0.7])
_LOW = np.array([-2.0, -50.0, 0.0, math.log(0.02)])
_HIGH = np.array([2.0, 200.0, 25.0, math.log(2.0)])


@dataclass(frozen=True, slots=True)
class IlcResponse:
    """``gain exp(-i w delay) / (1 - (w/w_n)^2 + 2 i zeta w/w_n)``.

    Attributes:
        gain: At frequency 0.
        delay_s: Delay; negative if the compensator leads too far.
        inverse_natural_s2: 1 / w_n^2, in s^2; 0 without a resonance.
        damping_ratio: zeta.
    """

    gain: float = 1.0
    delay_s: float = 0.0
    inverse_natural_s2: float = 0.0
    damping_ratio: float = 0.2

    def at(self, frequency_hz: F64) -> C128:
        """Return the response at frequencies in Hz: complex128[n]."""
        s = 2j * np.pi * frequency_hz
        slow = self.inverse_natural_s2
        resonance = 1.0 + 2.0 * self.damping_ratio * np.sqrt(slow) * s + slow * s**2
        answer: C128 = self.gain * np.exp(-s * self.delay_s) / resonance
        return answer

    @property
    def natural_hz(self) -> float | None:
        """Natural frequency; None without a resonance."""
        if self.inverse_natural_s2 <= 0.0:
            return None
        return float(1.0 / (2.0 * np.pi * np.sqrt(self.inverse_natural_s2)))


@dataclass(frozen=True, slots=True)
class IlcChange:
    """A change of a correction, complex128[K + 1], its effect on the error, and its noise."""

    step_hz: float
    correction_um: C128
    error_um: C128
    noise_um: F64

    def points(self) -> tuple[F64, C128, F64]:
        """Return frequencies, measured responses and weights of significant changes."""
        size = np.abs(self.correction_um)
        near = np.array([0.25, 0.5, 1.0, 0.0, 1.0, 0.5, 0.25])
        spread = np.sqrt(np.convolve(size**2, near)[3 : size.size + 3])
        doubt = self.noise_um + _COUPLING * spread
        clear = (size > _CLEAR * self.noise_um) & (size > doubt)
        clear[0] = False
        k = np.flatnonzero(clear)
        weight = size[k] / np.hypot(doubt[k], _COUPLING * size[k])
        return k.astype(np.float64) * self.step_hz, self.error_um[k] / self.correction_um[k], weight


def fit(
    changes: Sequence[IlcChange], first: tuple[float, complex], sample_rate_hz: float
) -> IlcResponse:
    """Fit the response to all changes.

    Before the first change, the response to the reference gives an estimate of delay and resonance,
    beyond the error of the remaining hysteresis: ``first`` holds the frequency of the reference's
    strongest harmonic, and displacement over reference.
    """
    parts = [change.points() for change in changes]
    frequency = np.concatenate([[first[0]], *(part[0] for part in parts)])
    measured = np.concatenate([[first[1]], *(part[1] for part in parts)])
    weight = np.concatenate([[1.0 / _FIRST_DOUBT], *(part[2] for part in parts)])
    highest = float(frequency.max())

    def residuals(x: F64) -> F64:
        off = weight * (_response_at(x, highest, sample_rate_hz).at(frequency) - measured)
        return np.concatenate((off.real, off.imag, (x - _BELIEVED) / _DOUBT))

    late = -math.atan2(first[1].imag, first[1].real) / (2.0 * math.pi * first[0])
    delays = (1.0, min(max(late * sample_rate_hz, 0.9 * _LOW[1]), 0.9 * _HIGH[1]))
    tries = [
        least_squares(
            residuals, [0.0, delay, slow, _BELIEVED[3]], bounds=(_LOW, _HIGH), loss="soft_l1"
        )
        for delay in delays
        for slow in (0.05, 0.7, 2.0)
    ]
    best = min(tries, key=lambda each: float(each.cost)).x
    if best[2] < (highest / sample_rate_hz) ** 2:  # above the sample rate: no resonance
        best[2] = 0.0
    return _response_at(best, highest, sample_rate_hz)


def _response_at(x: F64, highest_hz: float, sample_rate_hz: float) -> IlcResponse:
    slow = float(x[2]) / (2.0 * np.pi * highest_hz) ** 2
    return IlcResponse(float(np.exp(x[0])), float(x[1]) / sample_rate_hz, slow, float(np.exp(x[3])))


FIRST_GAIN = 0.7
"""Share of a harmonic's error that the first step removes."""

FULL_GAIN = 0.9
"""Largest share that a step removes."""

_LEAST_GAIN = 0.2
_LEAST_STEP = 0.01
"""Smallest gain after refused corrections: smaller corrections would be allowed but do not help."""

AT_FLOOR = 1.2
"""Multiple of the noise floor at which learning ends."""

_LEAST_FLOOR = 1e-6  # of the peak-to-peak
_FIRST_REACH = 0.01
"""First bandwidth as a share of the sample rate; a few samples of delay are a few degrees there."""

_FIRST_TURN_RAD = np.pi / 6.0
_WIDEN = 1.6
_NARROW = 0.7
_LEAST_WIDENING = 1.2
_TAPER = 1.25
_NOISE = 2.0
_LEAST_ANSWER = 0.15
_PATIENCE = 5
_WORTH = 0.95
_WORSE = 1.05


@dataclass(frozen=True, slots=True)
class IlcIteration:
    """One run: coefficients of its correction complex128[K + 1], its error and its bandwidth."""

    correction_um: C128
    error: CycleScore
    reach_hz: float


@dataclass(frozen=True, slots=True)
class IlcState:
    """State of the learning of one waveform.

    Attributes:
        highest_hz: Highest bandwidth.
        next_um: complex128[K + 1], correction for the next run.
        reach_hz: Its bandwidth; 0.0 before the first run.
        gain: Share of the error that the next step removes.
        widening: Factor of the bandwidth after an improvement.
        response: Response of the displacement to a change of the correction.
        limited: Whether a correction was refused, which made all later steps smaller.
    """

    sample_rate_hz: float
    highest_hz: float
    next_um: C128
    reach_hz: float = 0.0
    gain: float = FIRST_GAIN
    widening: float = _WIDEN
    response: IlcResponse = field(default_factory=IlcResponse)
    trials: tuple[IlcIteration, ...] = ()
    limited: bool = False
    done: str = ""

    @property
    def closest(self) -> IlcIteration:
        """The run with the smallest rms error, which is less sensitive to noise and corners."""
        return min(self.trials, key=lambda trial: trial.error.rms_um)


def learn(before: Sequence[IlcState], errors: Sequence[CycleScore]) -> tuple[IlcState, ...]:
    """Return the next states of learners, from their errors in the run with each ``next_um``."""
    states = tuple(map(_learned, before, errors))
    reason = _done(states)
    return _ended(states, reason) if reason else states


def best_run(states: Sequence[IlcState]) -> int:
    """Return the number of the run with the smallest error, see :func:`_scores`."""
    return int(np.argmin(_scores(states)))


def _scores(states: Sequence[IlcState]) -> F64:
    """Return the largest peak error of each run over the learner's noise floor: float64[runs]."""
    starts = [state.trials[0].error for state in states]
    floors_um = [max(each.floor_um, _LEAST_FLOOR * each.peak_to_peak_um) for each in starts]
    peaks_um = np.array([[trial.error.peak_um for trial in state.trials] for state in states])
    scores: F64 = (peaks_um / np.array(floors_um)[:, np.newaxis]).max(axis=0)
    return scores


def _ended(states: Sequence[IlcState], reason: str) -> tuple[IlcState, ...]:
    """Return the states with the corrections of the best run; these stay in further runs."""
    best = best_run(states)
    return tuple(
        replace(state, done=reason, next_um=state.trials[best].correction_um) for state in states
    )


def _learned(before: IlcState, error: CycleScore) -> IlcState:
    """Return the next state of one learner."""
    trial = IlcIteration(before.next_um, error, before.reach_hz)
    state = replace(before, trials=(*before.trials, trial))
    state = replace(state, response=_response(state))
    if not before.trials:
        state, base = _first(state), trial
    elif error.rms_um > _WORSE * before.closest.error.rms_um:
        base = before.closest
        state = _backed_off(state, base)
    else:
        base = trial
        gain = min(FULL_GAIN, 1.4 * before.gain)
        reach_hz = min(before.highest_hz, before.reach_hz * before.widening)
        state = replace(state, gain=gain, reach_hz=reach_hz)
    return replace(state, next_um=_moved(state, base))


def refused(before: Sequence[IlcState]) -> tuple[IlcState, ...]:
    """Return the next states after corrections that exceed the limits of the run."""
    if not before[0].trials:
        return tuple(before)
    states = tuple(
        replace(_backed_off(state, state.closest), gain=0.5 * state.gain, limited=True)
        for state in before
    )
    if min(state.gain for state in states) < _LEAST_STEP:
        return _ended(states, "at a limit")
    return tuple(replace(state, next_um=_moved(state, state.closest)) for state in states)


def _first(state: IlcState) -> IlcState:
    """Set the first bandwidth, below a phase of 30 degrees of the response."""
    step_hz = state.trials[0].error.step_hz
    frequency = np.linspace(0.0, 1.0, 101)[1:] * _FIRST_REACH * state.sample_rate_hz
    turned = np.abs(np.angle(state.response.at(frequency))) > _FIRST_TURN_RAD
    reach_hz = float(frequency[np.argmax(turned)] if turned.any() else frequency[-1])
    return replace(state, reach_hz=min(max(reach_hz, step_hz), state.highest_hz))


def _backed_off(state: IlcState, base: IlcIteration) -> IlcState:
    """Halve the gain, and return to the bandwidth of the base run, or reduce it if equal."""
    grown = state.reach_hz > base.reach_hz > 0.0
    reach_hz = base.reach_hz if grown else max(_NARROW * state.reach_hz, base.error.step_hz)
    widening = max(_LEAST_WIDENING, state.widening**0.5)
    gain = max(_LEAST_GAIN, 0.5 * state.gain)
    return replace(state, gain=gain, widening=widening, reach_hz=reach_hz)


def _changes(state: IlcState) -> list[IlcChange]:
    """Return the changes from run to run."""
    return [
        IlcChange(
            after.error.step_hz,
            after.correction_um - before.correction_um,
            after.error.harmonics_um - before.error.harmonics_um,
            np.hypot(after.error.noise_um, before.error.noise_um),
        )
        for before, after in pairwise(state.trials)
    ]


def _response(state: IlcState) -> IlcResponse:
    """Fit the response to all changes so far."""
    error = state.trials[0].error
    return fit(_changes(state), (error.strongest_hz, error.answer), state.sample_rate_hz)


def measured_response(state: IlcState) -> tuple[C128, F64]:
    """Return the response of each harmonic by its significant changes, and its doubt.

    Shapes: complex128[K + 1], float64[K + 1]. The doubt is a standard deviation; infinite, with a
    response of 0, without a change.
    """
    response, square, total_weight = np.zeros((3, state.next_um.size), dtype=np.complex128)
    for change in _changes(state):
        changed_hz, measured, weight = change.points()
        k = np.rint(changed_hz / change.step_hz).astype(np.int64)
        response[k] += weight**2 * measured
        square[k] += weight**2 * np.abs(measured) ** 2
        total_weight[k] += weight**2
    known = total_weight.real > 0.0
    weight = np.where(known, total_weight.real, 1.0)
    response /= weight
    scatter = np.maximum(0.0, square.real / weight - np.abs(response) ** 2)
    return response, np.where(known, np.sqrt(scatter + 1.0 / weight), np.inf)


def _answer(state: IlcState, frequency: F64) -> C128:
    """Return the mean of fitted and measured responses; the latter include further resonances."""
    fitted, (measured, doubt) = state.response.at(frequency), measured_response(state)
    certainty, own = (_FIT_DOUBT * np.abs(fitted)) ** -2.0, doubt**-2.0
    mean: C128 = (certainty * fitted + own * measured) / (certainty + own)
    return mean


def _moved(state: IlcState, base: IlcIteration) -> C128:
    """Return the correction one step from the best combination of a run with the others."""
    error = base.error
    frequency = np.arange(error.harmonics_um.size, dtype=np.float64) * error.step_hz
    answer = _answer(state, frequency)
    inverse = np.conj(answer) / (np.abs(answer) ** 2 + _LEAST_ANSWER**2)
    correction_um, error_um = _combined(state, base)
    step = inverse * error_um * _above_noise(error) * _taper(frequency, state.reach_hz)
    moved: C128 = correction_um - state.gain * step
    moved[0] = moved[0].real
    return moved


def _combined(state: IlcState, base: IlcIteration) -> tuple[C128, C128]:
    """Return the combination of all corrections with the smallest error, and that error.

    Between the runs, the error changes linearly with the correction (multisecant equations; D. G.
    Anderson, J. ACM 12 (1965) 547). This includes what a harmonic does to others.
    """
    others = [trial for trial in state.trials if trial is not base]
    moved_um = [trial.correction_um - base.correction_um for trial in others]
    changes_um = [trial.error.harmonics_um - base.error.harmonics_um for trial in others]
    noises_um = [np.hypot(trial.error.noise_um, base.error.noise_um) for trial in others]
    if not others:
        return base.correction_um, base.error.harmonics_um
    moved, changes = np.array(moved_um).T, np.array(changes_um).T
    products = (np.conj(changes.T) @ changes).real
    doubt = np.sum(np.square(noises_um), axis=1) + _CHANGE_DOUBT**2 * np.diag(products)
    against = (np.conj(changes.T) @ base.error.harmonics_um).real
    shares = -np.linalg.solve(products + np.diag(doubt), against)
    return base.correction_um + moved @ shares, base.error.harmonics_um + changes @ shares


def _above_noise(error: CycleScore) -> F64:
    """Return the weight of each harmonic's error: 0 within the noise, 1 well above it."""
    size = np.maximum(np.abs(error.harmonics_um), 1e-300)
    believed: F64 = np.maximum(0.0, 1.0 - (_NOISE * error.noise_um / size) ** 2)
    return believed


def _taper(frequency: F64, reach_hz: float) -> F64:
    """Return the zero-phase low-pass: 1 up to the bandwidth, 0 from 1.25 times it on."""
    outside = np.clip((frequency / reach_hz - 1.0) / (_TAPER - 1.0), 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * outside)


def _done(states: Sequence[IlcState]) -> str:
    scores = _scores(states)
    best = [state.trials[int(np.argmin(scores))].error for state in states]
    if all(error.peak_um <= AT_FLOOR * error.floor_um for error in best):
        return "at the noise floor"
    earlier = scores[:-_PATIENCE]
    if earlier.size and scores.min() > _WORTH * earlier.min():
        return f"no improvement in {_PATIENCE} runs"
    return ""
