"""Response to the largest step: rise, settling, overshoot, and the ringing after it.

After a step, a decaying sine (the mechanical structure) and a decaying exponential (creep) are
fitted together to the displacement.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hilctl.analysis.steady_state import loop_signals, trusted
from hilctl.base.errors import DataError
from hilctl.base.formatting import shown_briefly
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.recording.recording import Recording

_NOISE = 4.0  # standard deviations of the noise in half a band
SETTLED_PERCENT = 5.0
"""Default band about the end of a step, in percent of its height."""

_CYCLES = 8.0  # cycles of the ringing in the fit
_FEWEST = 40  # samples
_SEEN = 5.0  # least amplitude of the ringing over the misfit
_MOST_DAMPING = 0.9
_LOWEST_CYCLES = 4.0  # cycles of the slowest ringing in the signal
_HIGHEST = 0.1  # highest frequency of a ringing, as a share of the sample rate
_FREQUENCIES = 40
_REFINED = 3
_DAMPINGS = (0.05, 0.15, 0.4)
_RATES = (0.1, 0.5, 2.0)  # starting rates of the creep, over the angular frequency


@dataclass(frozen=True, slots=True)
class Ringing:
    """The ringing after a step: undamped natural frequency, damping, rms residual of the fit."""

    natural_hz: float
    damping_ratio: float
    misfit_um: float


def ringing(displacement_um: F64, sample_rate_hz: float) -> Ringing | None:
    """Fit the ringing of a displacement, float64[n], after a step; None without ringing."""
    if displacement_um.size < 2 * _FEWEST or not np.ptp(displacement_um) > 0.0:
        return None
    lowest_hz = _LOWEST_CYCLES * sample_rate_hz / displacement_um.size
    tried = [
        _start(displacement_um, sample_rate_hz, hz)
        for hz in np.geomspace(lowest_hz, _HIGHEST * sample_rate_hz, _FREQUENCIES)
    ]
    starts = sorted(tried, key=lambda start: start[0])[:_REFINED]
    found = [_refined(displacement_um, sample_rate_hz, start[1]) for start in starts]
    fits = [fit for fit, amplitude in found if amplitude > _SEEN * fit.misfit_um]
    best = min(fits, key=lambda fit: fit.misfit_um, default=None)
    return best if best and best.damping_ratio < _MOST_DAMPING else None


def _shapes(t: F64, x: F64) -> F64:
    """Return both phases of the ringing, the creep, and a constant: float64[4, n]."""
    # x: logarithms of natural angular frequency, damping ratio, and creep rate.
    omega, damping, rate = np.exp(x)
    decay, damped = np.exp(-damping * omega * t), omega * math.sqrt(max(1.0 - damping**2, 1e-6))
    ring = decay * np.cos(damped * t), decay * np.sin(damped * t)
    return np.stack([*ring, np.exp(-rate * t), np.ones(t.size)])


def _left(shapes: F64, y: F64) -> tuple[F64, F64]:
    """Return the residual of a least-squares fit of shapes, and its coefficients."""
    sizes = np.asarray(np.linalg.lstsq(shapes.T, y, rcond=None)[0], dtype=np.float64)
    return np.asarray(sizes @ shapes - y), sizes


def _window(displacement_um: F64, sample_rate_hz: float, hz: float) -> tuple[F64, F64]:
    count = max(_FEWEST, round(_CYCLES / hz * sample_rate_hz))
    y = displacement_um[:count]
    return np.arange(y.size) / sample_rate_hz, y


def _start(displacement_um: F64, sample_rate_hz: float, hz: float) -> tuple[float, F64]:
    """Return the misfit ratio of a ringing at a frequency, and starting values."""
    t, y = _window(displacement_um, sample_rate_hz, hz)
    omega = 2.0 * math.pi * hz
    best, start = math.inf, np.empty(0)
    creeps = math.inf
    for part in _RATES:
        for damping in _DAMPINGS:
            x = np.log([omega, damping, part * omega])
            shapes = _shapes(t, x)
            rms = float(np.linalg.norm(_left(shapes, y)[0]))
            if rms < best:
                best, start = rms, x
        creeps = min(creeps, float(np.linalg.norm(_left(shapes[2:], y)[0])))
    return best / max(creeps, 1e-300), start


def _refined(displacement_um: F64, sample_rate_hz: float, start: F64) -> tuple[Ringing, float]:
    """Return the fit from starting values, and the amplitude of its ringing in um."""
    t, y = _window(displacement_um, sample_rate_hz, math.exp(start[0]) / (2.0 * math.pi))
    spread = np.log([1.5, 20.0, 1e2])
    high = np.minimum(start + spread, [math.inf, math.log(0.98), math.inf])

    def left_by(x: F64) -> F64:
        return _left(_shapes(t, x), y)[0]

    found = least_squares(left_by, start, bounds=(start - spread, high))
    left, sizes = _left(_shapes(t, found.x), y)
    omega, damping, _ = np.exp(found.x)
    misfit_um = float(np.sqrt(np.mean(np.square(left))))
    fit = Ringing(float(omega / (2.0 * math.pi)), float(damping), misfit_um)
    return fit, math.hypot(sizes[0], sizes[1])


@shown_briefly
@dataclass(frozen=True, slots=True)
class StepResponse:
    """Response of the displacement to the largest step of a segment.

    Attributes:
        start_s: Time of the step in the run.
        dwell_s: Time to the next step, or to the end of the segment.
        height_um: Change of the displacement, to the mean of the last tenth before the next step.
        rise_s: Time from 10 to 90 % of the height.
        settling_s: Time from the step until the displacement stays within the band; None if the
            noise of the last tenth exceeds it.
        band_percent: The band about the end, in percent of the height.
        overshoot_percent: Largest excess over the height, in percent of it.
        natural_hz: Natural frequency of the ringing; None without ringing.
        damping_ratio: Its damping ratio; None without ringing.
    """

    path: Path
    start_s: float
    dwell_s: float
    height_um: float
    rise_s: float
    settling_s: float | None
    band_percent: float
    overshoot_percent: float
    natural_hz: float | None
    damping_ratio: float | None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, as ``hilctl step --json`` prints them."""
        return {**asdict(self), "path": str(self.path)}


def step_response(
    recording: Recording, band_percent: float = SETTLED_PERCENT, segment: Segment | None = None
) -> StepResponse:
    """Return the response to the largest step of a segment, the last step segment by default.

    Raise DataError if there is no step, or a displacement after it is not a number.
    """
    steps = [each for each in recording.segments if each.kind == "step"]
    if segment is None:
        if not steps:
            raise DataError(f"{recording.path}: has no step: record a waveform of kind step")
        segment = steps[-1]
    samples = trusted(recording.samples.part(segment.start, segment.stop))
    wanted, moved_um = loop_signals(samples, compensated=recording.compensated)
    moves = np.flatnonzero(np.diff(wanted))
    if not moves.size or not np.isfinite(moved_um).all():
        raise DataError(f"{recording.path}: {segment.label}: no step with a displacement")
    starts = moves[np.diff(moves, prepend=-2) > 1]
    stops = moves[np.diff(moves, append=wanted.size) > 1] + 1
    largest = int(np.argmax(np.abs(wanted[stops] - wanted[starts])))
    start, stop = int(starts[largest]), int(np.append(starts, wanted.size)[largest + 1])
    after_um, rate_hz = moved_um[start:stop], recording.sample_rate_hz
    last_um = after_um[-max(1, after_um.size // 10) :]
    height_um = float(last_um.mean() - after_um[0])
    part = (after_um - after_um[0]) / height_um if height_um else np.ones(after_um.size)
    band = 0.01 * band_percent
    outside = np.flatnonzero(np.abs(part - 1.0) > band)
    settles = _NOISE * float(np.std(last_um)) <= band * abs(height_um)
    rung = ringing(moved_um[stops[largest] + 1 : stop], rate_hz)
    return StepResponse(
        path=recording.path,
        start_s=int(samples.index[start]) / rate_hz,
        dwell_s=(stop - start) / rate_hz,
        height_um=height_um,
        rise_s=(_reached(part, 0.9) - _reached(part, 0.1)) / rate_hz,
        settling_s=(int(np.append(outside, 0).max()) + 1) / rate_hz if settles else None,
        band_percent=band_percent,
        overshoot_percent=100.0 * max(float(part.max()) - 1.0, 0.0),
        natural_hz=rung.natural_hz if rung else None,
        damping_ratio=rung.damping_ratio if rung else None,
    )


def _reached(part: F64, level: float) -> float:
    """Return the interpolated sample at which a step first reaches a level."""
    k = int(np.argmax(part >= level))
    return k - float((part[k] - level) / (part[k] - part[k - 1])) if k else 0.0
