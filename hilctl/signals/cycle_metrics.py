"""Figures of merit of an output-input loop, and of its sensor noise: pure functions of arrays.

Figures are judged on one average cycle: sensor noise would otherwise decide every maximum. What is
left of it puts a floor under the peak hysteresis. A figure without a meaning (no output, no second
branch) is None.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, I64

MAX_BINS = 1000
"""Most phase bins of an average cycle: at 1000 a sine's peak loses 2e-6 of its amplitude."""

SHORTEST_PERIOD = 16.0
"""Shortest period, in samples, at which the signal still passes for smooth beside the noise."""

MAD_TO_SIGMA = 1.482602218505602
"""Standard deviation of a normal distribution, of its median absolute deviation."""

_WIDEST_HOLE = 0.05
_FEWEST_BINS = 4
_ORDER = 6
NOISE_OVERLAP = _ORDER
"""Samples before a piece that its first windows of noise need."""
_GAIN = 924.0**0.5  # of white noise: the root of binomial(12, 6)
_FEWEST_WINDOWS = 32


@dataclass(frozen=True, slots=True)
class MeanCycle:
    """One cycle, averaged over several; it closes on itself.

    Attributes:
        phase: float64[m], mean phase of each bin's samples, in cycles from 0 to 1, rising.
        counts: int64[m], samples in each bin, > 0.
        signals: float64[k, m], mean of each signal in each bin.
    """

    phase: F64
    counts: I64
    signals: F64

    @property
    def whole(self) -> bool:
        """Whether the bins go round the cycle without a hole that a chord can't stand for.

        A hole is a stretch of phase without samples, wider than 5 % of the cycle and than one
        missing bin.
        """
        bins = self.phase.size
        if bins < _FEWEST_BINS:
            return False
        steps = np.diff(self.phase, append=self.phase[0] + 1.0)
        return float(steps.max()) <= max(_WIDEST_HOLE, 2.5 / bins)


class CycleAverager:
    """Averages cycles of paired signals on bins of phase, as their samples come.

    A sample's phase is its index modulo the period, so that gaps and periods that are not whole
    numbers of samples do no harm. All signals of a sample go to the same bin: their means stay
    paired. There is at most one bin a sample of a period; empty bins are left out, and so are
    samples of which a signal is not finite.

    Args:
        period: Samples in one period, > 0, not necessarily whole.
        signals: How many.
        max_bins: Most bins.
    """

    def __init__(self, period: float, signals: int, max_bins: int = MAX_BINS) -> None:
        bins = max(1, min(max_bins, int(period + 1e-9)))
        self._period = float(period)
        self._counts = np.zeros(bins, dtype=np.int64)
        self._sums = np.zeros((signals + 1, bins))

    def add(self, index: I64, signals: F64) -> None:
        """Take more samples.

        Args:
            index: int64[n], sample index; phase 0 is where it is a multiple of the period.
            signals: float64[k, n].
        """
        # Whole numbers are divided in a tenth of the time, with the same result.
        whole = self._period.is_integer()
        finite = np.isfinite(signals).all(axis=0)
        if not finite.all():
            index, signals = index[finite], signals[:, finite]
        bins = self._counts.size
        phase = (index % int(self._period) if whole else np.mod(index, self._period)).astype(float)
        # Multiply first: phase * bins is exact for whole periods, so that samples of one phase
        # can't be torn apart by rounding.
        bin_of = np.minimum((phase * bins / self._period).astype(np.int64), bins - 1)
        self._counts += np.bincount(bin_of, minlength=bins)
        self._sums += [np.bincount(bin_of, row, bins) for row in (phase, *signals)]

    def fold(self) -> MeanCycle:
        """Return the average cycle; of no bin where nothing is finite."""
        filled = self._counts > 0
        counts = self._counts[filled]
        means = self._sums[:, filled] / counts
        return MeanCycle(means[0] / self._period, counts, means[1:])


def fold(
    index: I64, period: float, signals: Sequence[F64] | F64, max_bins: int = MAX_BINS
) -> MeanCycle:
    """Average cycles of paired signals on bins of phase, see :class:`CycleAverager`.

    Args:
        index: int64[n], sample index; phase 0 is where it is a multiple of ``period``.
        period: Samples in one period, > 0, not necessarily whole.
        signals: float64[k, n], or k arrays, float64[n].
        max_bins: Most bins.

    Returns:
        The average cycle, of at most ``max_bins`` bins; of none where nothing is finite.
    """
    stacked = np.asarray(signals, dtype=np.float64)
    folding = CycleAverager(period, stacked.shape[0], max_bins)
    folding.add(index, stacked)
    return folding.fold()


@dataclass(frozen=True, slots=True)
class BranchGap:
    """The widest place of a hysteresis loop.

    Attributes:
        at_input: Input at which the rising and the falling branch lie furthest apart.
        low: Output of the lower branch there.
        high: Output of the upper branch there.
    """

    at_input: float
    low: float
    high: float

    @property
    def height(self) -> float:
        """Output difference between the two branches, H_P, in the output's unit."""
        return self.high - self.low


def widest_gap(loop_input: F64, output: F64) -> BranchGap | None:
    """Find where rising and falling branches of a closed loop differ most (figure 2.4).

    The loop is cut where its input turns round. At every input, each rising branch is held
    against each falling one, straight lines between the points, whichever of them lies above.
    Where the input has minor loops this takes in all pairs of branches.

    Args:
        loop_input: float64[m], one cycle in order of phase.
        output: float64[m].

    Returns:
        The widest place; None where no rising and falling branch share an input.
    """
    if loop_input.size < _FEWEST_BINS or np.ptp(loop_input) <= 0.0:
        return None
    rising, falling = _branches(loop_input, output)
    # Between points both branches are straight, so their distance is greatest at a point.
    grid = np.unique(loop_input)
    rising_low, rising_high = _band(rising, grid)
    falling_low, falling_high = _band(falling, grid)
    over = rising_high - falling_low
    under = falling_high - rising_low
    distance = np.fmax(over, under)
    if np.isnan(distance).all():
        return None
    k = int(np.nanargmax(distance))
    low, high = (
        (falling_low[k], rising_high[k])
        if over[k] >= under[k]
        else (rising_low[k], falling_high[k])
    )
    return BranchGap(float(grid[k]), float(low), float(high))


def _branches(loop_input: F64, output: F64) -> tuple[list[tuple[F64, F64]], list[tuple[F64, F64]]]:
    """Cut a closed loop into rising and falling branches, each with its input rising."""
    first = int(np.argmin(loop_input))
    u = np.append(np.roll(loop_input, -first), loop_input[first])
    y = np.append(np.roll(output, -first), output[first])
    sign = np.sign(np.diff(u))
    sign[0] = sign[0] or 1.0
    # Where the input stands still the branch goes on.
    last_move = np.maximum.accumulate(np.where(sign != 0.0, np.arange(sign.size), 0))
    sign = sign[last_move]
    turns = np.flatnonzero(np.diff(sign)) + 1
    rising: list[tuple[F64, F64]] = []
    falling: list[tuple[F64, F64]] = []
    for start, stop in zip((0, *turns), (*turns, sign.size), strict=True):
        part = slice(start, stop + 1)
        if sign[start] > 0.0:
            rising.append((u[part], y[part]))
        else:
            falling.append((u[part][::-1], y[part][::-1]))
    return rising, falling


def _band(branches: list[tuple[F64, F64]], grid: F64) -> tuple[F64, F64]:
    """Return the lowest and highest output of the branches over the grid; NaN where none is."""
    low, high = np.full(grid.size, np.nan), np.full(grid.size, np.nan)
    for u, y in branches:
        values = np.interp(grid, u, y, left=np.nan, right=np.nan)
        low, high = np.fmin(low, values), np.fmax(high, values)
    return low, high


def peak_hysteresis_percent(loop_input: F64, output: F64) -> float | None:
    """Return H_P / M_P: the widest gap over the peak-to-peak output, in percent (figure 2.4).

    It has no sign: compensated loops may be run through either way.

    Args:
        loop_input: float64[m], one cycle in order of phase.
        output: float64[m].
    """
    gap = widest_gap(loop_input, output)
    return None if gap is None else percent(gap.height, peak_to_peak(output))


def loop_area(loop_input: F64, output: F64) -> float:
    """Return the area enclosed by a closed loop, in output times input units (shoelace formula).

    Parts that are run through the other way round count against the rest.

    Args:
        loop_input: float64[m], one cycle in order of phase.
        output: float64[m].
    """
    u = loop_input - loop_input.mean()
    y = output - output.mean()
    return 0.5 * abs(float(np.dot(u, np.roll(y, -1)) - np.dot(np.roll(u, -1), y)))


def peak_to_peak(output: F64) -> float:
    """Return the largest less the smallest of float64[n], n > 0, in its unit."""
    return float(np.ptp(output))


def peak(error: F64) -> float:
    """Return the largest magnitude of float64[n], n > 0, in its unit."""
    return float(np.abs(error).max())


def rms(error: F64) -> float:
    """Return the root mean square of float64[n], n > 0, offset included, in its unit."""
    return float(np.sqrt(np.mean(np.square(error))))


def peak_and_rms_percent(error: F64, whole: float) -> tuple[float | None, float | None]:
    """Return :func:`peak` and :func:`rms` in percent of ``whole``; None where that is 0."""
    return percent(peak(error), whole), percent(rms(error), whole)


def percent(part: float, whole: float) -> float | None:
    """Return ``part`` in percent of ``whole``; None where ``whole`` is 0."""
    return 100.0 * part / whole if whole > 0.0 else None


def sensor_noise_um(index: I64, displacement_um: F64) -> float | None:
    """Estimate the rms of white noise that rides on a smooth displacement.

    What seven neighbouring samples have that no polynomial of degree 5 explains (their sixth
    difference, scaled to pass white noise with gain 1) is noise: of an 83 um sine at 250 Hz and
    50 kHz it leaves 1 pm. Its spread is taken from the median magnitude, so that spikes, steps and
    the corners of a triangle don't count. Noise that the sensor itself has low-passed is read too
    low: by 13 % at a bandwidth of 0.3 times the sample rate.

    Args:
        index: int64[n], sample index; windows with a gap are left out.
        displacement_um: float64[n]; values that are not finite count as gaps.

    Returns:
        rms in um; None with fewer than 32 windows.
    """
    finite = np.isfinite(displacement_um)
    windows = noise_windows_um(index[finite], displacement_um[finite])
    return noise_of(float(np.median(windows)), windows.size) if windows.size else None


def noise_windows_um(index: I64, displacement_um: F64) -> F64:
    """Return the magnitude of what no polynomial explains, of each window: float64[m], m <= n - 6.

    Args:
        index: int64[n], sample index; windows with a gap are left out.
        displacement_um: float64[n], finite.
    """
    unbroken = index[_ORDER:] - index[:-_ORDER] == _ORDER
    return np.asarray(np.abs(np.diff(displacement_um, _ORDER)[unbroken]))


def noise_of(median_um: float, windows: int) -> float | None:
    """Return the rms noise by the median of :func:`noise_windows_um`; None of too few windows."""
    return MAD_TO_SIGMA * median_um / _GAIN if windows >= _FEWEST_WINDOWS else None


def expected_maximum(values: int) -> float:
    """Return the expected largest magnitude of that many independent standard normal values."""
    x = np.linspace(0.0, 10.0, 2001)
    erf = np.array([math.erf(each) for each in (x / math.sqrt(2.0)).tolist()])
    below = erf**values
    return float(np.trapezoid(1.0 - below, x))


def noise_floor_percent(noise_um: float, counts: I64, peak_to_peak_um: float) -> float | None:
    """Return the peak hysteresis that noise alone makes of a loop without any.

    An average cycle of m bins has m/2 pairs of a rising and a falling bin; the difference of each
    pair has the noise of two bin means. The figure is the expected largest of them. Loops with
    several branches have more pairs and a floor up to about a fifth higher.

    Args:
        noise_um: rms of a single sample, in um.
        counts: int64[m], samples in each bin of the average cycle.
        peak_to_peak_um: Peak-to-peak of its output.

    Returns:
        Floor in percent of the peak-to-peak; None where that is 0 or there is no bin.
    """
    if counts.size == 0 or peak_to_peak_um <= 0.0:
        return None
    bin_noise_um = noise_um * math.sqrt(float(np.mean(1.0 / counts)))
    largest_um = expected_maximum(max(1, counts.size // 2)) * math.sqrt(2.0) * bin_noise_um
    return 100.0 * largest_um / peak_to_peak_um
