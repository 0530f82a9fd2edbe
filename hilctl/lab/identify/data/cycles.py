"""Steady cycles of recordings and histories: their period, and their average."""

import math
from collections.abc import Collection, Iterable

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.lab.identify.data.records import FEWEST_POINTS, History, SteadyLoop
from hilctl.recording.recording import Recording
from hilctl.signals.cycle_metrics import MAD_TO_SIGMA

LIKELY = 0.3  # minimum similarity of a candidate; a decay lowers it
PROMINENT = 0.02  # minimum prominence of a maximum above noise
LONGEST = 0.6  # longest period, of the number of samples
CANDIDATES = 50  # periods tried, from the shortest
STEADY = 0.02  # largest change from cycle to cycle in a steady part, of the peak-to-peak command
SURE = 4.5  # standard deviations of noise beyond it
ROUNDING = 0.02  # part of a period that may be missing from two
FULL = 0.5  # minimum peak-to-peak command of the steady part, of the total


def similarity(signal: F64) -> F64:
    """Return the autocorrelation of a signal without its mean, for lags beyond n / 2: float64[m].

    Each lag is normalised by the energy of the two parts it compares, so that 1 is a perfect
    repetition whatever the number of samples.
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
    """Find the shortest period of a command at full amplitude, and its steady part.

    Return the period in samples, and start and end of the steady part, which is at least two
    periods long. Raise DataError if it does not repeat.
    """
    alike = similarity(command)
    for top in _tops(alike)[:CANDIDATES].tolist():
        left, middle, right = alike[top - 1 : top + 2].tolist()  # the top of a parabola
        period = top + 0.5 * (left - right) / (left - 2.0 * middle + right)
        stretch = steady_stretch(command, period)
        if stretch is None:
            continue
        refined = _refined(command[slice(*stretch)], period)
        better = steady_stretch(command, refined)
        # The spectral line of two cycles is too wide to give their period.
        return (period, *stretch) if better is None else (refined, *better)
    raise DataError(
        f"{label}: no steady part in {command.size} samples: the command does not repeat at full "
        "amplitude for two cycles. Record steady cycles, or use --whole and a model without stages "
        "such as --model integrated"
    )


def _tops(alike: F64) -> I64:
    """Return the lags of maxima beyond the first zero; nearer ones are noise."""
    from scipy.signal import find_peaks  # it imports scipy.stats, which whole histories don't need

    first = max(int(np.argmax(alike <= 0.0)), FEWEST_POINTS)
    tops, _ = find_peaks(alike, height=LIKELY, prominence=PROMINENT)
    return np.asarray(tops[tops >= first], dtype=np.int64)


def _refined(command: F64, period: float) -> float:
    """Refine a period by the spectral lines of all cycles."""
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
    """Return the longest part in which a command repeats, if it has two periods; None otherwise."""
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


_LARGEST = 1e100  # limit of values, so that the spline stays finite


class CycleMean:
    """Mean cycle of samples that arrive in any number of pieces.

    Samples are averaged in bins around evenly spaced phases, at most one bin per sample of a
    period, so that a period of any length fills all bins. A periodic spline through the means, at
    the mean phase of their samples, gives the points.
    """

    def __init__(self, label: str, period: float, points: int, signals: int) -> None:
        bins = min(points, int(period + 1e-9))
        if bins < FEWEST_POINTS:
            raise DataError(
                f"{label}: needs at least {FEWEST_POINTS} samples and points a cycle, got "
                f"{period:g} samples and {points} points"
            )
        self._label, self._points, self._bins = label, points, bins
        self._count = np.zeros(bins, dtype=np.int64)
        self._offset = np.zeros(bins)
        self._sums = np.zeros((signals, bins))

    def add(self, phase: F64, values: F64) -> None:
        """Add signals, float64[m, n], at times in periods since the start of the first cycle."""
        bins = self._bins
        nearest = np.floor(phase * bins + 0.5)
        index = nearest.astype(np.int64) % bins
        self._count += np.bincount(index, minlength=bins)
        self._offset += np.bincount(index, phase * bins - nearest, bins)
        with np.errstate(invalid="ignore", over="ignore"):  # cycle() checks the sums
            self._sums += [np.bincount(index, row, bins) for row in values]

    def cycle(self) -> F64:
        """Return the mean cycle: float64[m, points]; the first point has phase 0."""
        if not self._count.all():
            missing = int(np.argmin(self._count))
            raise DataError(
                f"{self._label}: samples are missing at {missing / self._bins:.3f} of the "
                "cycle in all cycles"
            )
        knots = (np.arange(self._bins) + self._offset / self._count) / self._bins
        means = self._sums / self._count
        if not (np.abs(means) < _LARGEST).all():
            raise DataError(f"{self._label}: has values that are not finite or too large")
        closed = np.append(knots, knots[0] + 1.0), np.hstack([means, means[:, :1]])
        spline = CubicSpline(*closed, 1, bc_type="periodic")
        at = np.arange(self._points) / self._points
        return np.ascontiguousarray(spline(at), dtype=np.float64)


def average_cycle(label: str, phase: F64, values: F64, period: float, points: int) -> F64:
    """Return the mean cycle of a phase, float64[n] in periods, see :class:`CycleMean`."""
    mean = CycleMean(label, period, points, len(values))
    mean.add(phase, values)
    return mean.cycle()


def loops_from_pieces(
    pieces: Iterable[Recording], points: int = 300, labels: Collection[str] = ()
) -> tuple[SteadyLoop, ...]:
    """Return the averaged cycle of each segment; raise DataError if one is not steady."""
    found: list[_SegmentMean] | None = None
    for piece in pieces:
        if found is None:
            segments = _chosen(piece, labels)
            found = [_SegmentMean(piece, segment, points) for segment in segments]
        for each in found:
            each.add(piece)
    return tuple(each.loop() for each in found or ())


def _chosen(recording: Recording, labels: Collection[str]) -> list[Segment]:
    known = [segment.label for segment in recording.segments]
    unknown = [label for label in labels if label not in known]
    if unknown or not known:
        raise DataError(
            f"{recording.path}: no segment {', '.join(map(repr, unknown))}".rstrip()
            + f"; it has {', '.join(map(repr, known)) or 'none'}"
        )
    return [segment for segment in recording.segments if not labels or segment.label in labels]


class _SegmentMean:
    """Mean cycle of one segment of a recording that arrives in pieces."""

    def __init__(self, recording: Recording, segment: Segment, points: int) -> None:
        where = f"{recording.path}: segment {segment.label!r}"
        self._start, self._stop, cycles = segment.steady_cycles()
        if cycles == 0:
            raise DataError(
                f"{where}: no steady cycle (period {segment.period:g} samples, full amplitude from "
                f"{segment.steady_start} to {segment.steady_stop}). Run it longer or exclude it"
            )
        self._segment, self._rate_hz = segment, recording.sample_rate_hz
        self._mean = CycleMean(where, segment.period, points, 2)
        # Sums and numbers of samples in the first and the last half of the cycles.
        self._half = cycles // 2 * segment.period
        self._halves = np.zeros((2, 2))

    def add(self, piece: Recording) -> None:
        samples = piece.samples.part(self._start, self._stop)
        good = np.isfinite(samples.displacement_um)
        at = samples.index[good] - self._start
        phase = at / self._segment.period
        displacement_um = samples.displacement_um[good]
        self._mean.add(phase, np.stack([samples.command[good], displacement_um]))
        length = self._stop - self._start
        for half, inside in enumerate((at < self._half, at >= length - self._half)):
            self._halves[half] += displacement_um[inside].sum(), np.count_nonzero(inside)

    def loop(self) -> SteadyLoop:
        frequency_hz = self._rate_hz / self._segment.period
        command, displacement_um = self._mean.cycle()
        sums_um, counts = self._halves.T
        apart_s = (self._stop - self._start - self._half) / self._rate_hz
        drift_um_per_s = np.diff(sums_um / counts).item() / apart_s if counts.all() else 0.0
        return SteadyLoop(
            self._segment.label,
            command,
            displacement_um,
            frequency_hz,
            self._rate_hz,
            self._start / self._rate_hz,
            drift_um_per_s,
        )


def find_cycles(history: History, points: int = 300) -> SteadyLoop:
    """Return the averaged cycle of a history's periodic part; raise DataError without one."""
    # The first cycle is ignored, because its hysteresis depends on earlier motion.
    command = history.command[history.ignore :]
    displacement_um = history.displacement_um[history.ignore :]
    period, start, stop = find_period(history.label, command)
    cycles = max(int((stop - start) / period + 1e-9) - 1, 1)
    start = max(stop - round(cycles * period), start)
    phase = np.arange(stop - start) / period
    values = np.stack([command[start:stop], displacement_um[start:stop]])
    v, y = average_cycle(history.label, phase, values, period, points)
    return SteadyLoop(history.label, v, y, history.sample_rate_hz / period, history.sample_rate_hz)
