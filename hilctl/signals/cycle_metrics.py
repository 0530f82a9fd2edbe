"""Metrics of a hysteresis loop and its sensor noise: pure functions of arrays.

Metrics use one mean cycle, because sensor noise would otherwise dominate every maximum. The
remaining noise sets a floor for the peak hysteresis. An undefined metric (no output, no second
branch) is None.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, I64

MAX_BINS = 1000
"""Largest number of phase bins of a mean cycle; a sine's peak then loses 2e-6 of its amplitude."""

SHORTEST_PERIOD = 16.0
"""Shortest period, in samples, of a signal that is smooth compared to the noise."""

MAD_TO_SIGMA = 1.482602218505602
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""

_WIDEST_HOLE = 0.05
_FEWEST_BINS = 4
_ORDER = 6
NOISE_OVERLAP = _ORDER
"""Samples before a piece that its first noise windows need."""
_GAIN = 924.0**0.5  # of white noise: the root of binomial(12, 6)
_FEWEST_WINDOWS = 32


@dataclass(frozen=True, slots=True)
class MeanCycle:
    """The mean of several cycles, a closed loop.

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
        """Whether no gap of the bins is larger than 5 % of the cycle plus one missing bin."""
        bins = self.phase.size
        if bins < _FEWEST_BINS:
            return False
        steps = np.diff(self.phase, append=self.phase[0] + 1.0)
        return float(steps.max()) <= max(_WIDEST_HOLE, 2.5 / bins)


class CycleAverager:
    """Incremental mean of cycles of paired signals on phase bins.

    A sample's phase is its index modulo the period, > 0 samples, not necessarily whole, so gaps are
    allowed. All signals of a sample are added to the same bin, so their means stay paired. There is
    at most one bin per sample of a period; empty bins and samples with a non-finite signal are
    skipped.
    """

    def __init__(self, period: float, signals: int, max_bins: int = MAX_BINS) -> None:
        bins = max(1, min(max_bins, int(period + 1e-9)))
        self._period = float(period)
        self._counts = np.zeros(bins, dtype=np.int64)
        self._sums = np.zeros((signals + 1, bins))

    def add(self, index: I64, signals: F64) -> None:
        """Add signals, float64[k, n], of samples, int64[n]; phase 0 at multiples of the period."""
        # Integer division is ten times faster, with the same result.
        whole = self._period.is_integer()
        finite = np.isfinite(signals).all(axis=0)
        if not finite.all():
            index, signals = index[finite], signals[:, finite]
        bins = self._counts.size
        phase = (index % int(self._period) if whole else np.mod(index, self._period)).astype(float)
        # Multiply first: phase * bins is exact for whole periods, so that rounding cannot split
        # samples of one phase.
        bin_of = np.minimum((phase * bins / self._period).astype(np.int64), bins - 1)
        self._counts += np.bincount(bin_of, minlength=bins)
        self._sums += [np.bincount(bin_of, row, bins) for row in (phase, *signals)]

    def fold(self) -> MeanCycle:
        """Return the mean cycle, without bins if nothing is finite."""
        filled = self._counts > 0
        counts = self._counts[filled]
        means = self._sums[:, filled] / counts
        return MeanCycle(means[0] / self._period, counts, means[1:])


def fold(
    index: I64, period: float, signals: Sequence[F64] | F64, max_bins: int = MAX_BINS
) -> MeanCycle:
    """Return the mean cycle of k paired signals, float64[n] each, see :class:`CycleAverager`."""
    stacked = np.asarray(signals, dtype=np.float64)
    folding = CycleAverager(period, stacked.shape[0], max_bins)
    folding.add(index, stacked)
    return folding.fold()


@dataclass(frozen=True, slots=True)
class BranchGap:
    """The largest distance between the branches of a hysteresis loop.

    Attributes:
        at_input: Input at that distance.
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
    """Return the largest gap between rising and falling branches of a closed loop (figure 2.4).

    Input and output are float64[m], one cycle in order of phase. The loop is split where its input
    turns. At every input each rising branch is compared with each falling one, with linear
    interpolation; this includes the branches of minor loops. None if no branches share an input.
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
    """Split a closed loop into rising and falling branches, each in order of rising input."""
    first = int(np.argmin(loop_input))
    u = np.append(np.roll(loop_input, -first), loop_input[first])
    y = np.append(np.roll(output, -first), output[first])
    sign = np.sign(np.diff(u))
    sign[0] = sign[0] or 1.0
    # A branch continues while the input is constant.
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
    """Return the lowest and highest output of the branches over the grid; NaN without a branch."""
    low, high = np.full(grid.size, np.nan), np.full(grid.size, np.nan)
    for u, y in branches:
        values = np.interp(grid, u, y, left=np.nan, right=np.nan)
        low, high = np.fmin(low, values), np.fmax(high, values)
    return low, high


def peak_hysteresis_percent(loop_input: F64, output: F64) -> float | None:
    """Return H_P / M_P of :func:`widest_gap`: the gap over the peak-to-peak output, in percent.

    It is unsigned, because compensated loops may have either direction.
    """
    gap = widest_gap(loop_input, output)
    return None if gap is None else percent(gap.height, peak_to_peak(output))


def loop_area(loop_input: F64, output: F64) -> float:
    """Return the area of a closed loop, see :func:`widest_gap`, in output times input units.

    Parts with the opposite direction count negatively (shoelace formula).
    """
    u = loop_input - loop_input.mean()
    y = output - output.mean()
    return 0.5 * abs(float(np.dot(u, np.roll(y, -1)) - np.dot(np.roll(u, -1), y)))


def peak_to_peak(output: F64) -> float:
    """Return the peak-to-peak value of float64[n], n > 0, in its unit."""
    return float(np.ptp(output))


def peak(error: F64) -> float:
    """Return the largest magnitude of float64[n], n > 0, in its unit."""
    return float(np.abs(error).max())


def rms(error: F64) -> float:
    """Return the root mean square of float64[n], n > 0, offset included, in its unit."""
    return float(np.sqrt(np.mean(np.square(error))))


def peak_and_rms_percent(error: F64, whole: float) -> tuple[float | None, float | None]:
    """Return :func:`peak` and :func:`rms` in percent of ``whole``; None if that is 0."""
    return percent(peak(error), whole), percent(rms(error), whole)


def percent(part: float, whole: float) -> float | None:
    """Return ``part`` in percent of ``whole``; None if ``whole`` is 0."""
    return 100.0 * part / whole if whole > 0.0 else None


def sensor_noise_um(index: I64, displacement_um: F64) -> float | None:
    """Estimate the rms of white noise on a smooth displacement; None with fewer than 32 windows.

    The noise is the residual of seven neighbouring samples from a polynomial of degree 5 (their
    sixth difference, scaled to gain 1 for white noise); for an 83 um sine at 250 Hz and 50 kHz that
    is 1 pm. The median magnitude is insensitive to spikes, steps and the corners of a triangle.
    Low-passed noise is underestimated: by 13 % at a bandwidth of 0.3 times the sample rate. Windows
    with a gap of the sample index, int64[n], or a reading that is not finite are skipped.
    """
    finite = np.isfinite(displacement_um)
    windows = noise_windows_um(index[finite], displacement_um[finite])
    return noise_of(float(np.median(windows)), windows.size) if windows.size else None


def noise_windows_um(index: I64, displacement_um: F64) -> F64:
    """Return the residual magnitude of each window without a gap: float64[m], m <= n - 6."""
    unbroken = index[_ORDER:] - index[:-_ORDER] == _ORDER
    return np.asarray(np.abs(np.diff(displacement_um, _ORDER)[unbroken]))


def noise_of(median_um: float, windows: int) -> float | None:
    """Return the rms noise from a median of :func:`noise_windows_um`; None for too few windows."""
    return MAD_TO_SIGMA * median_um / _GAIN if windows >= _FEWEST_WINDOWS else None


def expected_maximum(values: int) -> float:
    """Return the expected largest magnitude of independent standard normal values."""
    x = np.linspace(0.0, 10.0, 2001)
    erf = np.array([math.erf(each) for each in (x / math.sqrt(2.0)).tolist()])
    below = erf**values
    return float(np.trapezoid(1.0 - below, x))


def noise_floor_percent(noise_um: float, counts: I64, peak_to_peak_um: float) -> float | None:
    """Return the peak hysteresis of a loop without hysteresis, due to noise of an rms in um.

    A mean cycle of m bins, with ``counts`` samples each, has m/2 pairs of a rising and a falling
    bin; the difference of each pair has the noise of two bin means. The result is the expected
    maximum, in percent of the peak-to-peak, or None. Loops with several branches have more pairs
    and a floor up to about 20 % higher.
    """
    if counts.size == 0 or peak_to_peak_um <= 0.0:
        return None
    bin_noise_um = noise_um * math.sqrt(float(np.mean(1.0 / counts)))
    largest_um = expected_maximum(max(1, counts.size // 2)) * math.sqrt(2.0) * bin_noise_um
    return 100.0 * largest_um / peak_to_peak_um
