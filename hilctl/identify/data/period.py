"""The period of a command, and the stretch over which it repeats."""

import math

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.optimize import minimize_scalar

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64
from hilctl.identify.data.records import FEWEST_POINTS
from hilctl.signals.cycle_metrics import MAD_TO_SIGMA

LIKELY = 0.3  # least similarity worth a closer look; a decay lowers it
PROMINENT = 0.02  # how far a top stands out: noise has many that do not
LONGEST = 0.6  # of the samples: longest period looked for
CANDIDATES = 50  # periods looked at, from the shortest
STEADY = 0.02  # largest change from cycle to cycle in a steady part, of the peak-to-peak command
SURE = 4.5  # standard deviations of noise beyond it
ROUNDING = 0.02  # of a period that may be missing of two
FULL = 0.5  # least peak-to-peak command of the steady part, of that of all


def similarity(signal: F64) -> F64:
    """Return the autocorrelation of a signal with its mean taken out.

    Each lag is divided by the energy of the two parts it compares, so that 1 is a perfect
    repetition however few samples are left to compare.

    Returns:
        float64[m], for lags from 0 to a little beyond n / 2: two cycles have their period there.
    """
    x = signal - signal.mean()
    n = x.size
    spectrum = rfft(x, next_fast_len(2 * n, real=True))
    longest = min(math.ceil(LONGEST * n), n - 1)
    products = irfft(np.abs(spectrum) ** 2, next_fast_len(2 * n, real=True))[: longest + 1]
    energy = np.concatenate(([0.0], np.cumsum(x * x)))
    lags = np.arange(longest + 1)
    early, late = energy[n - lags], energy[n] - energy[lags]
    scale = np.sqrt(np.maximum(early * late, np.finfo(np.float64).tiny))
    return np.asarray(products / scale, dtype=np.float64)


def find_period(label: str, command: F64) -> tuple[float, int, int]:
    """Find the shortest period with which a command repeats at full amplitude, and where it does.

    Returns:
        Period in samples, not necessarily whole; first sample and sample after the last of the
        steady part, which is at least two periods long.

    Raises:
        DataError: It does not repeat.
    """
    alike = similarity(command)
    for top in _tops(alike)[:CANDIDATES]:
        period = _parabola(alike, int(top))
        stretch = steady_stretch(command, period)
        if stretch is None:
            continue
        refined = _refined(command[slice(*stretch)], period)
        better = steady_stretch(command, refined)
        # Of two cycles the spectral line is so wide that it need not be where their period is.
        return (period, *stretch) if better is None else (refined, *better)
    raise DataError(
        f"{label}: no steady part in {command.size} samples: the command doesn't repeat at full "
        "amplitude for two cycles: judge it as a whole with --whole, and a model without stages "
        "(--model integrated, say), or record steady cycles"
    )


def _tops(alike: F64) -> I64:
    """Return the lags of the maxima beyond the first zero: nearer ones are noise."""
    from scipy.signal import find_peaks  # it imports scipy.stats, which whole histories don't need

    first = max(int(np.argmax(alike <= 0.0)), FEWEST_POINTS)
    tops, _ = find_peaks(alike, height=LIKELY, prominence=PROMINENT)
    return np.asarray(tops[tops >= first], dtype=np.int64)


def _parabola(values: F64, top: int) -> float:
    left, middle, right = values[top - 1 : top + 2]
    return top + 0.5 * float((left - right) / (left - 2.0 * middle + right))


def _refined(command: F64, period: float) -> float:
    """Sharpen a period on as many cycles as there are: their spectral line is the strongest."""
    window = np.hanning(command.size) * (command - command.mean())
    time = np.arange(command.size)

    def missing(candidate: float) -> float:
        turns = np.exp(-2j * np.pi * np.outer(harmonics, time) / candidate)
        return -float(np.sum(np.abs(turns @ window) ** 2))

    harmonics = np.arange(1, 4)
    width = 0.5 * period * period / command.size
    found = minimize_scalar(
        missing, bounds=(period - width, period + width), options={"xatol": 1e-6 * period}
    )
    return float(found.x)


def steady_stretch(command: F64, period: float) -> tuple[int, int] | None:
    """Return the longest stretch over which a command repeats at full amplitude.

    Args:
        command: float64[n].
        period: Samples a period.

    Returns:
        First sample and sample after the last, two periods at least but for rounding; None where
        there is none.
    """
    span = float(np.ptp(command))
    later = np.arange(command.size - math.ceil(period))
    again = np.interp(later + period, np.arange(command.size), command)
    changes = again - command[later]
    steps = np.abs(np.diff(changes))
    noise = MAD_TO_SIGMA * float(np.median(steps)) / math.sqrt(2.0) if steps.size else 0.0
    same = np.abs(changes) <= STEADY * span + SURE * noise
    edges = np.flatnonzero(np.diff(np.concatenate(([0], same.astype(np.int8), [0]))))
    best: tuple[int, int] | None = None
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        stop = min(int(end + period), command.size)
        if end - start < (1.0 - ROUNDING) * period or np.ptp(command[start:stop]) < FULL * span:
            continue
        if best is None or stop - start > best[1] - best[0]:
            best = (start, stop)
    return best
