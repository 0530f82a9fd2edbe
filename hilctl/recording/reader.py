"""From an MCAP file to a recording in memory, whole or in pieces."""

import logging
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.base.files import no_such_file, reason
from hilctl.recording.builder import RecordingBuilder
from hilctl.recording.index import places_of
from hilctl.recording.locks import is_being_recorded
from hilctl.recording.recording import Recording
from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.time_range import TimeRange

_log = logging.getLogger(__name__)

PIECE_SAMPLES = 2**18
"""Fewest samples per piece."""


def read(path: Path, stretch: TimeRange | None = None) -> Recording:
    """Read a recording; if it was truncated or damaged, everything that is whole.

    Nothing is written. Missing data is logged as a warning, in one line. All arrays have one shape
    and rise where they must, whatever the file contains; time and memory stay in proportion to its
    size, or to that of a stretch of it. Of a finished file, only the stretch is read and checked.

    Args:
        path: The recording.
        stretch: What to keep of it; everything if None.

    Raises:
        DataError: The file can't be read, is not an MCAP file, holds what hilctl can't have
            written, or no sample of the stretch.
    """
    (whole,) = _read(path, stretch, piece_samples=None)
    return stretch.cut(whole) if stretch else whole


class RecordingStream:
    """A recording of any length, a piece at a time; each iteration reads the file anew.

    Every piece is a :class:`~hilctl.recording.recording.Recording` of the next samples, ticks,
    events and replay starts. The last one, which may hold no sample, has the end, the number of
    missing samples and, of a stretch, the segments as they are cut. Together they are what
    :func:`read` returns.

    Args:
        path: The recording.
        stretch: What to read of it; everything if None.
    """

    def __init__(self, path: Path, stretch: TimeRange | None = None) -> None:
        self.path = path
        self.stretch = stretch

    def __iter__(self) -> Iterator[Recording]:
        """Yield the pieces.

        Raises:
            DataError: As :func:`read` does, and if facts of the run follow its samples.
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
    """Yield pieces of that many samples, uncut; all in one if None."""
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
        problem = "is still being recorded" if live else scan.describe()
        _warn(path, problem, builder.samples, live=live)
    yield last


def _warn(path: Path, problem: str, samples: int, *, live: bool) -> None:
    advice = "" if live else " ('hilctl recover' makes it a whole file again, and keeps this one)"
    _log.warning("%s: %s; %d samples are read%s", path, problem, samples, advice)
