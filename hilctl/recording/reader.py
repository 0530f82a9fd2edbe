"""From an MCAP file to a recording in memory, or to one piece of it after the other."""

import logging
import os
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.base.remedy import no_such_file, reason
from hilctl.recording.ahead import ReadAhead
from hilctl.recording.data import Recording
from hilctl.recording.gathering import Gathering
from hilctl.recording.index import places_of
from hilctl.recording.locks import is_being_recorded
from hilctl.recording.salvage import Salvage
from hilctl.recording.stretch import Stretch

_log = logging.getLogger(__name__)

LONG_BYTES = 8 * 2**20
"""A file as large is read ahead: loading what that takes is worth it then."""
LONG_CHUNKS = 64
"""So is a stretch of one in as many places."""
PIECE_SAMPLES = 2**18
"""Fewest samples of a piece: what is worked on then stays in a processor's cache."""

_PIECES = 2  # at once in the making


def read(path: Path, stretch: Stretch | None = None) -> Recording:
    """Read a recording; of one that was cut short or damaged, all that is whole.

    Nothing is written. That something is missing is logged as a warning, in one line. All that is
    given out is of one shape and rises where it must, whatever the file says; time and memory stay
    in proportion to its size, or to that of a stretch of it: of a finished file, nothing else is
    read, or found to be damaged.

    Args:
        path: The recording.
        stretch: What to keep of it; all where None.

    Raises:
        DataError: The file can't be read, is not an MCAP file, holds what hilctl can't have
            written, or no sample of the stretch.
    """
    (whole,) = _read(path, stretch, piece_samples=None)
    return stretch.cut(whole) if stretch else whole


class Pieces:
    """A recording of any length, a piece at a time; each walk over it reads the file anew.

    Every piece is a :class:`~hilctl.recording.data.Recording` of the samples, ticks, events and
    replay starts that come next; end, missing samples and, of a stretch, segments as they are cut
    stand in the last one, which may hold no sample. Together they are what :func:`read` returns.

    Args:
        path: The recording.
        stretch: What to give of it; all where None.
    """

    def __init__(self, path: Path, stretch: Stretch | None = None) -> None:
        self.path = path
        self.stretch = stretch

    def __iter__(self) -> Iterator[Recording]:
        """Yield the pieces.

        Raises:
            DataError: As :func:`read` does, and where facts of the run stand behind samples.
        """
        pieces = _beforehand(_read(self.path, self.stretch, PIECE_SAMPLES))
        return self.stretch.cut_pieces(pieces) if self.stretch else pieces


def _beforehand(pieces: Generator[Recording, None, None]) -> Iterator[Recording]:
    """Yield pieces, while a thread gathers those that come next."""
    thread = ThreadPoolExecutor(1, thread_name_prefix="gathering")
    try:
        coming = deque(thread.submit(next, pieces, None) for _ in range(_PIECES))
        while (piece := coming.popleft().result()) is not None:
            coming.append(thread.submit(next, pieces, None))
            yield piece
    finally:
        thread.shutdown(cancel_futures=True)
        pieces.close()


def _read(
    path: Path, stretch: Stretch | None, piece_samples: int | None
) -> Generator[Recording, None, None]:
    """Yield pieces of that many samples, uncut; all in one where None."""
    try:
        with path.open("rb") as stream, ExitStack() as closed:
            places = places_of(stream, stretch) if stretch else None
            status = os.fstat(stream.fileno())
            ahead = None
            if status.st_size >= LONG_BYTES and (places is None or len(places) >= LONG_CHUNKS):
                beside = closed.enter_context(path.open("rb", buffering=0))
                if os.path.samestat(status, os.fstat(beside.fileno())):  # nobody has replaced it
                    ahead = closed.enter_context(closing(ReadAhead(beside)))
            salvage = Salvage(stream, ahead=ahead)
            gathered = Gathering(salvage, stretch)
            records = salvage.taken() if places is None else salvage.taken_at(places)
            for record in records:
                gathered.take(record)
                if piece_samples and gathered.waiting >= piece_samples:
                    yield gathered.piece(path)
            live = not salvage.sound and is_being_recorded(stream)
    except FileNotFoundError:
        raise DataError(no_such_file(path)) from None
    except OSError as error:
        raise DataError(f"{path}: can't be read: {reason(error)}") from None
    except DataError as error:
        text = str(error).removeprefix(f"{path}: ")  # of a piece, it is there already
        raise DataError(f"{path}: {text}") from None
    last = gathered.piece(path, last=True)
    if not salvage.sound:
        problem = "is still being recorded" if live else salvage.describe()
        _warn(path, problem, gathered.samples, live=live)
    yield last


def _warn(path: Path, problem: str, samples: int, *, live: bool) -> None:
    advice = "" if live else " ('hilctl recover' makes it a whole file again, and keeps this one)"
    _log.warning("%s: %s; %d samples are read%s", path, problem, samples, advice)
