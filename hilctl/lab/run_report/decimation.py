"""Decimation of long recordings for plots, in bounded memory.

A short recording is kept. Of a longer one, each interval keeps the samples with the lowest and the
highest displacement, reference, command and error, and each segment its last evaluated samples.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from hilctl.analysis.report import Windows, build_report
from hilctl.analysis.run_metrics import RunReport
from hilctl.analysis.steady_state import Overview, SteadyPart, loop_signals, trusted
from hilctl.base.events import Event
from hilctl.base.samples import Samples
from hilctl.base.types import I64
from hilctl.recording.recording import Recording, Ticks
from hilctl.signals.cycle_metrics import MeanCycle

MOST_SAMPLES = 2**22
"""Most samples of a recording that is not decimated."""

_STRETCHES = 2**16  # a plot has 4000 points
_LAST_SAMPLES = 2**18  # all segments together
_MOST_TICKS = 2**20

_Columns = TypeVar("_Columns", Samples, Ticks)


def overview(pieces: Iterable[Recording]) -> tuple[RunReport, Recording]:
    """Return the report of a recording, and a decimated recording with the same plots.

    Ticks are decimated evenly; the latest one is kept. The pieces of the run are a repeatable
    iterable, because a run that ended early or was tuned is read twice. Raise DataError as
    :func:`hilctl.analysis.report.summarize` does.
    """
    shown: list[_Shown] = []

    def observe(windows: Windows) -> Callable[[Recording], None]:
        shown[:] = [_Shown(windows)]
        return shown[0].add

    builder = build_report(pieces, observe)
    return builder.report(), shown[0].recording(builder.cycles())


class _Shown:
    """Builder of the recording for plots."""

    def __init__(self, windows: Windows) -> None:
        self._windows = windows
        self._held: list[Recording] = []
        self._thinned: _Thinned | None = None

    def add(self, piece: Recording) -> None:
        """Take the next piece."""
        if self._thinned:
            self._thinned.add(piece)
            return
        self._held.append(piece)
        if sum(each.samples.index.size for each in self._held) > MOST_SAMPLES:
            self._thinned = _Thinned(self._windows)
            while self._held:
                self._thinned.add(self._held.pop(0))

    def recording(self, cycles: Sequence[MeanCycle | None]) -> Recording:
        """Return the recording, with the average cycle of each segment."""
        return self._thinned.recording(cycles) if self._thinned else _joined(self._held)


def _joined(pieces: list[Recording]) -> Recording:
    """Return one recording of all pieces."""
    if len(pieces) == 1:
        return pieces[0]
    return replace(
        pieces[-1],
        samples=_together([piece.samples for piece in pieces]),
        ticks=_together([piece.ticks for piece in pieces]),
        events=tuple(event for piece in pieces for event in piece.events),
        starts=tuple(start for piece in pieces for start in piece.starts),
    )


def _together(parts: Sequence[_Columns]) -> _Columns:
    names = [each.name for each in fields(parts[0])]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return type(parts[0])(**columns)


class _Thinned:
    """Builder of a decimated recording."""

    def __init__(self, windows: Windows) -> None:
        self._windows = windows
        self._last: Recording | None = None
        self._shown: list[Samples] = []
        self._size = 0
        self._ticks = _SampledTicks()
        most = _LAST_SAMPLES // max(1, len(windows))
        self._parts = [_Part(window, most) for _, window in windows]
        self._per_stretch = 0
        self._events: list[Event] = []

    def add(self, piece: Recording) -> None:
        self._last = piece
        self._events += piece.events
        if not self._per_stretch:
            longest = max((segment.stop for segment in piece.segments), default=0)
            self._per_stretch = max(16, longest // _STRETCHES)
        self._ticks.add(piece.ticks)
        for part in self._parts:
            part.add(piece)
        rows = _extreme_rows(piece.samples, self._per_stretch)
        self._shown.append(piece.samples.rows(rows))
        self._size += rows.size
        if self._size > MOST_SAMPLES:  # longer than planned
            self._per_stretch *= 4
            together = _together(self._shown)
            rows = _extreme_rows(together, 32)
            self._shown, self._size = [together.rows(rows)], rows.size

    def recording(self, cycles: Sequence[MeanCycle | None]) -> Overview:
        assert self._last is not None
        parts = {
            segment: part.steady_part(cycle)
            for (segment, _), part, cycle in zip(self._windows, self._parts, cycles, strict=True)
        }
        samples = _together([*self._shown, *(part.last_samples() for part in self._parts)])
        _, rows = np.unique(samples.index, return_index=True)
        named = {each.name: getattr(self._last, each.name) for each in fields(Recording)}
        named |= {"samples": samples.rows(rows), "ticks": self._ticks.ticks()}
        named |= {"events": tuple(self._events), "starts": ()}
        return Overview(**named, windows=dict(self._windows), parts=parts)


def _extreme_rows(samples: Samples, per_stretch: int) -> I64:
    """Return the first row of each interval, and those in which a signal is lowest or highest."""
    whole = samples.index.size // per_stretch * per_stretch
    places = np.arange(0, whole, per_stretch)
    rows = [places, np.arange(whole, samples.index.size)]
    error_um = samples.displacement_um - samples.reference_um
    for values in (samples.displacement_um, samples.reference_um, samples.command, error_um):
        shaped = values[:whole].reshape(-1, per_stretch)
        finite = np.isfinite(shaped)
        low = high = shaped
        if not finite.all():
            low, high = np.where(finite, shaped, np.inf), np.where(finite, shaped, -np.inf)
        rows += places + low.argmin(axis=1), places + high.argmax(axis=1)
    return np.unique(np.concatenate(rows))


class _Part:
    """Last ``most`` steady samples of a segment."""

    def __init__(self, window: tuple[int, int, int], most: int) -> None:
        self._start, self._stop, self._cycles = window
        self._most = most
        self._kept: deque[Samples] = deque()
        self._size = 0
        self._compensated = False

    def add(self, piece: Recording) -> None:
        index = piece.samples.index
        elsewhere = index.size == 0 or index[-1] < self._start or index[0] >= self._stop
        if elsewhere and self._kept:
            return
        part = trusted(piece.samples.part(self._start, self._stop))
        self._compensated = piece.compensated
        self._kept.append(part)
        self._size += part.index.size
        while self._size - self._kept[0].index.size >= self._most > 0:
            self._size -= self._kept.popleft().index.size

    def last_samples(self) -> Samples:
        return _together(self._kept).rows(slice(-self._most, None))

    def steady_part(self, cycle: MeanCycle | None) -> SteadyPart:
        """Return the steady part with the average cycle of all its samples, if it has one."""
        samples = self.last_samples()
        signals = loop_signals(samples, compensated=self._compensated)
        return SteadyPart.of(samples, self._cycles, cycle, signals)


class _SampledTicks:
    """Evenly decimated ticks, and the latest one."""

    def __init__(self) -> None:
        self._every = 1
        self._seen = 0
        self._kept: list[Ticks] = []
        self._latest: Ticks | None = None

    def add(self, ticks: Ticks) -> None:
        size = ticks.late_ns.size
        if size == 0:
            return
        self._kept.append(ticks.rows(np.arange(-self._seen % self._every, size, self._every)))
        self._seen += size
        latest = ticks.rows(np.array([int(np.argmax(ticks.late_ns))]))
        if self._latest is None or latest.late_ns[0] > self._latest.late_ns[0]:
            self._latest = latest
        if sum(each.late_ns.size for each in self._kept) > _MOST_TICKS:
            self._every *= 2
            together = _together(self._kept)
            self._kept = [together.rows(np.arange(0, together.late_ns.size, 2))]

    def ticks(self) -> Ticks:
        if self._latest is None:
            return Ticks(*(np.empty(0, dtype=np.int64),) * 4)
        together = _together([*self._kept, self._latest])
        _, rows = np.unique(together.first_sample, return_index=True)
        return together.rows(rows)
