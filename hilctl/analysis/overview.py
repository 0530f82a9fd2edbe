"""What plots need of a recording of any length, in bounded memory.

A recording that is short enough is taken as it is. Of a longer one every spike stays: of each even
stretch the samples with the lowest and the highest displacement, reference, command and error are
kept, and all of the last samples that are judged of each segment.
"""

from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from itertools import chain, islice

import numpy as np

from hilctl.analysis.report import Windows
from hilctl.analysis.steady import Overview, SteadyPart, trusted
from hilctl.base.arrays import F64, I64
from hilctl.base.events import Event
from hilctl.base.metrics import Folding
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.recording.data import Recording, Ticks

MOST_SAMPLES = 2**22
"""Most samples of a recording that is taken as it is."""

_STRETCHES = 2**16  # a plot has 4000 points
_LAST_SAMPLES = 2**18  # all segments together
_MOST_TICKS = 2**20


def overview(pieces: Iterable[Recording], windows: Windows) -> Recording:
    """Return a recording whose plots are those of the whole.

    Of its ticks, where they are many, every so manieth is there, and the latest.

    Args:
        pieces: At least one, in order.
        windows: What is judged of it, see :func:`hilctl.analysis.report.summarize_windows`.
    """
    coming = iter(pieces)
    held: list[Recording] = []
    while sum(piece.samples.index.size for piece in held) <= MOST_SAMPLES:
        more = list(islice(coming, 1))
        if not more:
            return _joined(held)
        held += more
    return _thinned(chain(held, coming), windows)


def _joined(pieces: list[Recording]) -> Recording:
    """Return one recording of all pieces."""
    if len(pieces) == 1:
        return pieces[0]
    return replace(
        pieces[-1],
        samples=_samples_of([piece.samples for piece in pieces]),
        ticks=_ticks_of([piece.ticks for piece in pieces]),
        events=tuple(event for piece in pieces for event in piece.events),
        starts=tuple(start for piece in pieces for start in piece.starts),
    )


def _samples_of(parts: list[Samples]) -> Samples:
    filled = [part for part in parts if part.index.size] or parts[:1]
    names = [each.name for each in fields(Samples)]
    return Samples(**{name: np.concatenate([getattr(p, name) for p in filled]) for name in names})


def _ticks_of(parts: list[Ticks]) -> Ticks:
    names = [each.name for each in fields(Ticks)]
    return Ticks(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _thinned(pieces: Iterator[Recording], windows: Windows) -> Overview:
    last: Recording | None = None
    shown: list[Samples] = []
    ticks = _SomeTicks()
    most = _LAST_SAMPLES // max(1, len(windows))
    gathered = [_Part(*window, most) for window in windows]
    per_stretch = 0
    events: list[Event] = []
    for piece in pieces:
        last = piece
        events += piece.events
        if not per_stretch:
            longest = max((segment.stop for segment in piece.segments), default=0)
            per_stretch = max(16, longest // _STRETCHES)
        ticks.add(piece.ticks)
        for part in gathered:
            part.add(piece)
        shown.append(_rows_of(piece.samples, _extreme_rows(piece.samples, per_stretch)))
        if sum(each.index.size for each in shown) > MOST_SAMPLES:  # longer than was planned
            per_stretch *= 4
            together = _samples_of(shown)
            shown = [_rows_of(together, _extreme_rows(together, 32))]
    assert last is not None
    parts = {part.segment: part.steady_part() for part in gathered}
    samples = _with(_samples_of(shown), [part.last_samples() for part in gathered])
    named = {each.name: getattr(last, each.name) for each in fields(Recording)}
    named |= {"samples": samples, "ticks": ticks.ticks(), "events": tuple(events), "starts": ()}
    return Overview(**named, windows=dict(windows), parts=parts)


def _extreme_rows(samples: Samples, per_stretch: int) -> I64:
    """Return the rows of each stretch in which a signal is lowest or highest, and its first."""
    whole = samples.index.size // per_stretch * per_stretch
    places = np.arange(0, whole, per_stretch)
    rows = [places, np.arange(whole, samples.index.size)]
    error_um = samples.displacement_um - samples.reference_um
    for values in (samples.displacement_um, samples.reference_um, samples.command, error_um):
        shaped = values[:whole].reshape(-1, per_stretch)
        finite = np.isfinite(shaped)
        rows.append(places + np.where(finite, shaped, np.inf).argmin(axis=1))
        rows.append(places + np.where(finite, shaped, -np.inf).argmax(axis=1))
    return np.unique(np.concatenate(rows))


def _with(samples: Samples, more: list[Samples]) -> Samples:
    """Return samples and others, in order and each once."""
    together = _samples_of([samples, *more])
    _, rows = np.unique(together.index, return_index=True)
    return _rows_of(together, rows)


def _rows_of(samples: Samples, rows: I64) -> Samples:
    values = {each.name: getattr(samples, each.name) for each in fields(Samples)}
    return Samples(**{name: each[rows] if each.size else each for name, each in values.items()})


class _Part:
    """Gathers the steady part of a segment, with its last samples.

    Args:
        segment: The segment.
        window: Its judged samples: first, after the last, whole cycles.
        most: Most samples to keep.
    """

    def __init__(self, segment: Segment, window: tuple[int, int, int], most: int) -> None:
        self.segment = segment
        self._start, self._stop, self._cycles = window
        self._most = most
        self._folding = Folding(segment.period, 2) if self._cycles else None
        self._kept: Samples | None = None
        self._compensated = False

    def add(self, piece: Recording) -> None:
        index = piece.samples.index
        elsewhere = index.size == 0 or index[-1] < self._start or index[0] >= self._stop
        if elsewhere and self._kept is not None:
            return
        part = trusted(piece.samples.part(self._start, self._stop))
        self._compensated = piece.compensated
        if self._folding and part.index.size:
            self._folding.add(part.index - self.segment.start, self._loop(part))
        kept = part if self._kept is None else self._kept.followed_by(part)
        self._kept = kept.rows(slice(-self._most, None))

    def _loop(self, samples: Samples) -> F64:
        loop_input = samples.reference_um if self._compensated else samples.command
        return np.array((loop_input, samples.displacement_um))

    def last_samples(self) -> Samples:
        assert self._kept is not None
        return self._kept

    def steady_part(self) -> SteadyPart:
        samples = self.last_samples()
        if self._folding is None:
            loop = self._loop(samples)
            return SteadyPart(samples, 0, None, loop[:, np.isfinite(loop).all(axis=0)])
        cycle = self._folding.fold()
        if not cycle.whole:
            return SteadyPart(samples, self._cycles, None, np.empty((2, 0)))
        return SteadyPart(samples, self._cycles, cycle, cycle.signals)


class _SomeTicks:
    """Keeps every so manieth tick, and the latest."""

    def __init__(self) -> None:
        self._every = 1
        self._seen = 0
        self._kept: list[Ticks] = []
        self._latest: Ticks | None = None

    def add(self, ticks: Ticks) -> None:
        size = ticks.late_ns.size
        if size == 0:
            return
        self._kept.append(_rows(ticks, np.arange(-self._seen % self._every, size, self._every)))
        self._seen += size
        latest = _rows(ticks, np.array([int(np.argmax(ticks.late_ns))]))
        if self._latest is None or latest.late_ns[0] > self._latest.late_ns[0]:
            self._latest = latest
        if sum(each.late_ns.size for each in self._kept) > _MOST_TICKS:
            self._every *= 2
            together = _ticks_of(self._kept)
            self._kept = [_rows(together, np.arange(0, together.late_ns.size, 2))]

    def ticks(self) -> Ticks:
        if self._latest is None:
            return Ticks(*(np.empty(0, dtype=np.int64),) * 4)
        together = _ticks_of(self._kept)
        if self._latest.first_sample[0] in together.first_sample:
            return together
        place = int(np.searchsorted(together.first_sample, self._latest.first_sample[0]))
        return _ticks_of([
            _rows(together, np.arange(place)), self._latest,
            _rows(together, np.arange(place, together.late_ns.size)),
        ])  # fmt: skip


def _rows(ticks: Ticks, rows: I64) -> Ticks:
    return Ticks(**{each.name: getattr(ticks, each.name)[rows] for each in fields(Ticks)})
