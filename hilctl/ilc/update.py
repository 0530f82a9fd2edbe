"""Update of the correction from the errors so far: pure functions of frozen state.

Each harmonic of the correction moves against its error by the inverse of the identified response
(:mod:`hilctl.ilc.response`). The bandwidth grows while the error falls. If the error grows, the
next step starts from the best correction, with half the gain and a smaller bandwidth.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from hilctl.base.types import C128, F64
from hilctl.ilc.cycle import CycleScore
from hilctl.ilc.response import Change, Response, fit

FIRST_GAIN = 0.7
"""Share of a harmonic's error that the first step removes."""

FULL_GAIN = 0.9
"""Largest share that a step removes."""

_LEAST_GAIN = 0.2

AT_FLOOR = 1.2
"""Multiple of the noise floor at which learning ends."""

_FIRST_REACH = 0.01
"""First bandwidth as a share of the sample rate, where a delay of some samples is some degrees."""

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
    """

    sample_rate_hz: float
    highest_hz: float
    next_um: C128
    reach_hz: float = 0.0
    gain: float = FIRST_GAIN
    widening: float = _WIDEN
    response: Response = field(default_factory=Response)
    trials: tuple[IlcIteration, ...] = ()
    done: str = ""

    @property
    def best(self) -> IlcIteration:
        """The run with the smallest peak error."""
        return min(self.trials, key=lambda trial: trial.error.peak_um)

    @property
    def closest(self) -> IlcIteration:
        """The run with the smallest rms error, which is less sensitive to noise and corners."""
        return min(self.trials, key=lambda trial: trial.error.rms_um)


def learn(before: IlcState, error: CycleScore) -> IlcState:
    """Return the next state, from the error of the run with ``before.next_um``."""
    trial = IlcIteration(before.next_um, error, before.reach_hz)
    state = replace(before, trials=(*before.trials, trial))
    state = replace(state, response=_response(state))
    if reason := _done(state):
        return replace(state, done=reason)
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


def refused(before: IlcState) -> IlcState:
    """Return the next state after a correction that exceeds the limits of the run."""
    if before.done or not before.trials:
        return before
    base = before.closest
    state = _backed_off(before, base)
    return replace(state, next_um=_moved(state, base))


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


def _response(state: IlcState) -> Response:
    """Fit the response to all changes so far."""
    changes = [
        Change(
            after.error.step_hz,
            after.correction_um - before.correction_um,
            after.error.harmonics_um - before.error.harmonics_um,
            np.hypot(after.error.noise_um, before.error.noise_um),
        )
        for before, after in pairwise(state.trials)
    ]
    error = state.trials[0].error
    return fit(changes, (error.strongest_hz, error.answer), state.sample_rate_hz)


def _moved(state: IlcState, base: IlcIteration) -> C128:
    """Return the correction one step from that of a run."""
    error = base.error
    frequency = np.arange(error.harmonics_um.size, dtype=np.float64) * error.step_hz
    answer = state.response.at(frequency)
    inverse = np.conj(answer) / (np.abs(answer) ** 2 + _LEAST_ANSWER**2)
    step = inverse * error.harmonics_um * _above_noise(error) * _taper(frequency, state.reach_hz)
    moved: C128 = base.correction_um - state.gain * step
    moved[0] = moved[0].real
    return moved


def _above_noise(error: CycleScore) -> F64:
    """Return the weight of each harmonic's error: 0 within the noise, 1 well above it."""
    size = np.maximum(np.abs(error.harmonics_um), 1e-300)
    believed: F64 = np.maximum(0.0, 1.0 - (_NOISE * error.noise_um / size) ** 2)
    return believed


def _taper(frequency: F64, reach_hz: float) -> F64:
    """Return the zero-phase low-pass: 1 up to the bandwidth, 0 from 1.25 times it on."""
    outside = np.clip((frequency / reach_hz - 1.0) / (_TAPER - 1.0), 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * outside)


def _done(state: IlcState) -> str:
    best = state.best.error
    if best.peak_um <= AT_FLOOR * best.floor_um:
        return "at the noise floor"
    earlier = state.trials[:-_PATIENCE]
    if earlier and best.peak_um > _WORTH * min(trial.error.peak_um for trial in earlier):
        return f"no better in {_PATIENCE} runs"
    return ""
