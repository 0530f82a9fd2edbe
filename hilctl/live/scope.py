"""Signals of a run; windows of an oscilloscope (rolling or triggered) and hysteresis loops."""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.samples import NO_WAVEFORM, BlockBatch
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64, U32


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal: name for programs, label to display, and unit.

    The unit is ``um``, ``command`` for the unit of the commands, or a text for an auxiliary
    channel.
    """

    name: str
    label: str
    unit: str


SIGNALS = (
    Signal("reference", "reference", "um"),
    Signal("displacement", "displacement", "um"),
    Signal("error", "error", "um"),
    Signal("command", "command", "command"),
    Signal("measured", "measured command", "command"),
    Signal("wanted", "command before the limiter", "command"),
)
"""The signals of every run, in row order of every array of signals; auxiliary channels follow."""
ROW = {signal.name: row for row, signal in enumerate(SIGNALS)}


@dataclass(frozen=True, slots=True)
class Traces:
    """Signals of n samples in order."""

    index: I64  # int64[n], sample index since the start of the run; a jump is a gap
    values: F64  # float64[signals, n]; NaN if there is no value
    flags: U32  # uint32[n], bits of :class:`hilctl.base.samples.Flag`

    def rows(self, chosen: slice) -> "Traces":
        """Return the selected samples."""
        return Traces(self.index[chosen], self.values[:, chosen], self.flags[chosen])

    def part(self, start: float, stop: float) -> "Traces":
        """Return the samples with an index in [start, stop)."""
        low, high = np.searchsorted(self.index, (start, stop))
        return self.rows(slice(int(low), int(high)))


def traces_of(batch: BlockBatch, waveform_unit: str) -> Traces:
    """Return the signals of blocks; without a reference in um there is no error."""
    samples = batch.samples()
    reference = samples.reference_um
    if waveform_unit != "um":
        reference = np.full_like(reference, np.nan)
    displacement_um, error_um = samples.displacement_um, samples.displacement_um - reference
    values = np.array(
        (reference, displacement_um, error_um, samples.command, samples.measured, samples.wanted)
    )
    if samples.aux.size:
        values = np.concatenate((values, samples.aux.T))
    values[~np.isfinite(values)] = np.nan
    return Traces(samples.index, values, samples.flags)


WINDOWS_S = (0.02, 0.1, 0.5, 2.0, 10.0, 60.0, 600.0)
"""Lengths of rolling windows in s."""
BUCKETS = 600
"""Buckets per window."""
KEPT = 6 * BUCKETS
"""Stored buckets of each rolling window, so that a path has more points than a window."""
CYCLES = 6
"""Stored cycles of the loop."""
_CYCLE_BUCKETS = 300
_LONG_S = 1.0
_LOOP_S = 2.0


@dataclass(frozen=True, slots=True)
class Buckets:
    """Consecutive buckets of samples: float64[signals, n] each."""

    low: F64  # minimum of each signal; NaN if a bucket has no sample
    high: F64  # maximum
    first: F64  # value of the first sample


class MinMaxTrace:
    """Newest buckets of a run, with minimum, maximum and first value of each signal.

    The range of each bucket is drawn, so an outlier is visible in an hour as well as in a second.
    Bucket 0 begins at sample ``origin``; ``width`` is the samples per bucket, >= 1, may be
    fractional; ``keep`` is the number of stored buckets.
    """

    def __init__(self, origin: float, width: float, keep: int, signals: int = len(SIGNALS)) -> None:
        self.origin, self.width, self.keep = origin, width, keep
        self.newest = -1
        """Number of the newest bucket with a sample; -1 before the first."""
        self._stored = np.full((3, signals, keep), np.nan)  # low, high, first

    def add(self, traces: Traces) -> None:
        """Add the next samples; ignore those before the origin or the newest bucket."""
        numbers = np.floor((traces.index - self.origin) / self.width).astype(np.int64)
        begin = int(np.searchsorted(numbers, max(self.newest, 0)))
        if begin == numbers.size:
            return
        numbers, values = numbers[begin:], traces.values[:, begin:]
        starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
        numbers, first = numbers[starts], values[:, starts]
        low = np.fmin.reduceat(values, starts, axis=1)
        high = np.fmax.reduceat(values, starts, axis=1)
        if numbers[0] == self.newest:  # it already has samples
            before = self._stored[:, :, self.newest % self.keep]
            low[:, 0] = np.fmin(low[:, 0], before[0])
            high[:, 0] = np.fmax(high[:, 0], before[1])
            first[:, 0] = before[2]
        newest = int(numbers[-1])
        passed = np.arange(max(self.newest + 1, newest - self.keep + 1), newest + 1)
        self._stored[:, :, passed % self.keep] = np.nan
        slots = numbers[-self.keep :] % self.keep
        self._stored[:, :, slots] = np.stack((low, high, first))[:, :, -self.keep :]
        self.newest = newest

    def window(self, begin: int, count: int) -> Buckets:
        """Return buckets from number ``begin``; those that are not stored are empty."""
        numbers: I64 = np.arange(begin, begin + count)
        there = (numbers >= 0) & (numbers <= self.newest) & (numbers > self.newest - self.keep)
        return Buckets(*np.where(there, self._stored[:, :, numbers % self.keep], np.nan))


@dataclass(frozen=True, slots=True)
class ScopeWindow:
    """Content of a scope."""

    t_s: F64  # float64[n], start of each bucket: relative to now, or to the start of the cycle
    buckets: Buckets


class Scope:
    """The windows of one run; ``loop_input`` is the signal on the abscissa of the loop."""

    def __init__(
        self,
        sample_rate_hz: float,
        segments: list[Segment],
        loop_input: str,
        signals: int = len(SIGNALS),
    ) -> None:
        self._rate_hz = sample_rate_hz
        self._segments, self._input, self._signals = segments, ROW[loop_input], signals
        self._rolling = {
            window_s: MinMaxTrace(
                0, max(1, math.ceil(window_s * sample_rate_hz / BUCKETS)), KEPT, signals
            )
            for window_s in WINDOWS_S
        }
        self._cycles: MinMaxTrace | None = None
        self._cycle_buckets: float = _CYCLE_BUCKETS
        self.segment: Segment | None = None
        """Segment of the newest sample of the waveform."""

    def add(self, traces: Traces) -> None:
        """Add the next samples."""
        for trace in self._rolling.values():
            trace.add(traces)
        running = traces.index[(traces.flags & NO_WAVEFORM) == 0]
        if not running.size:
            return
        self._follow(int(running[-1]))
        if self._cycles is not None:
            # Not the soft end: the last steady cycle stays visible.
            stop = running[-1] + 1 if self.segment is None else self.segment.steady_stop
            self._cycles.add(traces.part(running[0], min(running[-1] + 1, stop)))

    def _follow(self, sample: int) -> None:
        here = next((each for each in self._segments if each.start <= sample < each.stop), None)
        if here is None or here is self.segment:
            return
        self.segment = here
        samples = here.period if here.period > 0.0 else _LOOP_S * self._rate_hz
        width = max(1.0, samples / _CYCLE_BUCKETS)
        self._cycle_buckets = here.period / width if here.period > 0.0 else _CYCLE_BUCKETS
        keep = math.ceil((CYCLES + 2) * self._cycle_buckets)
        self._cycles = MinMaxTrace(here.start, width, keep, self._signals)

    def rolling(self, window_s: float) -> ScopeWindow:
        """Return the newest ``window_s``, one of :data:`WINDOWS_S`."""
        trace = self._rolling[window_s]
        count = min(BUCKETS, max(2, math.ceil(window_s * self._rate_hz / trace.width)))
        t_s = np.arange(1 - count, 1) * (trace.width / self._rate_hz)
        return ScopeWindow(t_s.astype(np.float64), trace.window(trace.newest - count + 1, count))

    def densest(self, window_s: float) -> MinMaxTrace:
        """Return the trace with the shortest buckets that stores ``window_s``."""
        samples = window_s * self._rate_hz
        return next(each for each in self._rolling.values() if each.width * each.keep >= samples)

    def whole_buckets(self, window_s: float, since: int) -> tuple[int, int, Buckets]:
        """Return the completed buckets of a rolling window from number ``since``.

        Before them, the number of the first that is still stored, and the samples per bucket.
        """
        trace = self._rolling[window_s]
        first = max(since, trace.newest - trace.keep + 1, 0)
        return first, int(trace.width), trace.window(first, max(0, trace.newest - first))

    def triggered(self) -> ScopeWindow | None:
        """Return the two newest complete cycles of the waveform; None before the first two.

        A long cycle is shown while it is recorded.
        """
        trace, segment, cycle = self._cycles, self.segment, self._cycle_buckets
        if trace is None or segment is None or segment.period <= 0.0:
            return None
        done = (trace.newest + 1) / cycle
        live = segment.period > _LONG_S * self._rate_hz
        begin = math.floor(done) - (1 if live else 2)
        if begin < 0:
            return None
        first = math.ceil(begin * cycle - 1e-9)
        count = math.ceil(2.0 * cycle)
        t_s = (np.arange(first, first + count) - begin * cycle) * (trace.width / self._rate_hz)
        return ScopeWindow(t_s.astype(np.float64), trace.window(first, count))

    def loops(self) -> F64:
        """Return input and displacement of the newest loops: float64[2, n], oldest first."""
        trace = self._cycles
        if trace is None:
            return np.empty((2, 0))
        count = min(math.ceil(CYCLES * self._cycle_buckets), trace.newest + 1)
        first = trace.window(trace.newest - count + 1, count).first
        return first[[self._input, ROW["displacement"]]]

    def points_a_cycle(self) -> int:
        """Return the number of points of :meth:`loops` per cycle."""
        return max(1, round(self._cycle_buckets))
