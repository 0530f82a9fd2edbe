"""A stretch of a run, by time: only its samples are kept in memory, however long the run was."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace

from hilctl.base.errors import DataError
from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import Segment
from hilctl.recording.recording import Recording, Ticks

_OF_ANY_PART = {"code", "reason", "output_safe", "output_state", "ended", "recovered"}
"""Facts of the end that hold for every part of a run; the others count the whole of it."""


@dataclass(frozen=True, slots=True)
class TimeRange:
    """From one time of a run to another.

    Attributes:
        from_s: First time, in s since the start of the run; None for its start.
        to_s: Time to stop before; None for its end.
    """

    from_s: float | None = None
    to_s: float | None = None

    def samples(self, sample_rate_hz: float) -> tuple[int, int]:
        """Return the index of the first sample at ``from_s`` or later, and of that at ``to_s``.

        Raises:
            DataError: A time is not a finite number.
        """
        start = 0 if self.from_s is None else _first_at_or_after(self.from_s, sample_rate_hz)
        stop = LAST_SAMPLE if self.to_s is None else _first_at_or_after(self.to_s, sample_rate_hz)
        return start, stop

    def cut(self, recording: Recording) -> Recording:
        """Return what a recording holds of it, with all events.

        Segments are cut to what lies within. Counters of the whole run are left out; samples that
        are missing are those between the first and the last that are there.

        Raises:
            DataError: The recording holds no sample of it.
        """
        (whole,) = self.cut_pieces([recording])
        return whole

    def cut_pieces(self, pieces: Iterable[Recording]) -> Iterator[Recording]:
        """Cut the pieces of a :class:`hilctl.recording.reader.RecordingStream`.

        What can be said only of all that is there stands in the last one: counters, and segments
        that end with its last sample.

        Raises:
            DataError: There is no sample of it.
        """
        held: Recording | None = None
        given = found = first = end = 0
        for piece in pieces:
            if held is not None:
                yield held
            held = self._part(piece)
            index = held.samples.index
            given += piece.samples.index.size
            if index.size:
                first, end = first if found else int(index[0]), int(index[-1]) + 1
                found += index.size
        if held is None or not found:
            whole = "its samples are elsewhere" if given else "it has none"
            path = held.path if held else "the recording"
            raise DataError(f"{path}: holds no sample from {self}: {whole}")
        yield replace(
            held,
            segments=tuple(_cut(piece.segments, first, end)),
            dropped=end - first - found,
            end={name: text for name, text in held.end.items() if name in _OF_ANY_PART},
        )

    def _part(self, piece: Recording) -> Recording:
        start, stop = self.samples(piece.sample_rate_hz)
        ticks = piece.ticks
        within = (ticks.first_sample >= start) & (ticks.first_sample < stop)
        return replace(
            piece,
            samples=piece.samples.part(start, stop),
            segments=tuple(_cut(piece.segments, start, stop)),
            ticks=Ticks(**{each.name: getattr(ticks, each.name)[within] for each in fields(ticks)}),
            starts=tuple(each for each in piece.starts if start <= each.sample < stop),
        )

    def __str__(self) -> str:
        start = "its start" if self.from_s is None else f"{self.from_s:g} s"
        return f"{start} to {'its end' if self.to_s is None else f'{self.to_s:g} s'}"


def _cut(segments: tuple[Segment, ...], start: int, stop: int) -> Iterator[Segment]:
    """Yield what lies within; a segment keeps its first sample, which its phase is counted from."""
    for each in segments:
        end = min(each.stop, stop)
        steady_start = min(max(each.steady_start, start), end)
        if start < each.stop and each.start < stop:
            steady_stop = max(steady_start, min(each.steady_stop, end))
            yield replace(each, stop=end, steady_start=steady_start, steady_stop=steady_stop)


def _first_at_or_after(t_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at ``t_s`` or later, rounding errors forgiven."""
    if not math.isfinite(t_s):
        raise DataError(f"a time must be a finite number of seconds: {t_s!r}")
    far = float(LAST_SAMPLE)
    place = min(max(t_s * rate_hz, -far), far)  # beyond it there is no sample
    return math.ceil(place - 1e-6)
