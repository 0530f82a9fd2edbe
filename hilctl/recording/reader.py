"""Reading of MCAP files, whole or in pieces."""

import logging
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.base.files import no_such_file, reason
from hilctl.recording.builder import RecordingBuilder
from hilctl.recording.recording import Recording
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.time_range import TimeRange, places_of

_log = logging.getLogger(__name__)

PIECE_SAMPLES = 2**18
"""Fewest samples per piece."""


def read(path: Path, stretch: TimeRange | None = None) -> Recording:
    """Read a recording, or the valid part of a truncated or damaged one.

    Missing data is logged as one warning. Arrays have consistent lengths and indices increase,
    whatever the file contains; time and memory are in proportion to its size, or to that of the
    time range. Of a finished file, only the time range is read and checked.

    Raises:
        DataError: The file cannot be read, is not a valid recording, or has no sample in the range.
    """
    (whole,) = _read(path, stretch, piece_samples=None)
    return stretch.cut(whole) if stretch else whole


class RecordingStream:
    """A recording of any length, in pieces; each iteration reads the file again.

    Every piece is a :class:`~hilctl.recording.recording.Recording` of the next samples, ticks,
    events and replay starts. The last one, which may have no samples, also has the end, the number
    of missing samples and the segments cut to the time range. Joined, the pieces are the result of
    :func:`read`.
    """

    def __init__(self, path: Path, stretch: TimeRange | None = None) -> None:
        self.path = path
        self.stretch = stretch

    def __iter__(self) -> Iterator[Recording]:
        """Yield the pieces.

        Raises:
            DataError: See :func:`read`; also if facts of the run follow its samples.
        """
        pieces = _prefetched(_read(self.path, self.stretch, PIECE_SAMPLES))
        return self.stretch.cut_pieces(pieces) if self.stretch else pieces


def _prefetched(pieces: Generator[Recording, None, None]) -> Iterator[Recording]:
    """Yield pieces while a thread reads the next one."""
    with closing(pieces), ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, pieces, None)
        while (piece := coming.result()) is not None:
            coming = thread.submit(next, pieces, None)
            yield piece


def _read(
    path: Path, stretch: TimeRange | None, piece_samples: int | None
) -> Generator[Recording, None, None]:
    """Yield pieces of at least that many samples, uncut; one piece if None."""
    try:
        with path.open("rb") as stream:
            places = places_of(stream, stretch) if stretch else None
            scan = RecoveryScan(stream)
            builder = RecordingBuilder(scan, stretch)
            for record in scan.records() if places is None else scan.records_at(places):
                builder.take(record)
                if piece_samples and builder.waiting >= piece_samples:
                    yield builder.piece(path)
            live = not scan.sound and is_being_recorded(stream)
    except FileNotFoundError:
        raise DataError(no_such_file(path)) from None
    except OSError as error:
        raise DataError(f"{path}: can't be read: {reason(error)}") from None
    except DataError as error:
        text = str(error).removeprefix(f"{path}: ")  # that of a piece has it already
        raise DataError(f"{path}: {text}") from None
    last = builder.piece(path, last=True)
    if not scan.sound:
        problem, advice = "is still being recorded", ""
        if not live:
            problem = scan.describe()
            advice = " ('hilctl recover' makes it a whole file again, and keeps this one)"
        _log.warning("%s: %s; %d samples are read%s", path, problem, builder.samples, advice)
    yield last
