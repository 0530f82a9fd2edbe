"""Make a sound recording out of one that was cut short or damaged; its bytes are kept.

The file is walked through twice: first to see what is wrong and what it holds, then, only where
something is wrong, to save every whole record into a new file through the MCAP library's writer,
which makes index, statistics and checksums anew.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.events import Event
from hilctl.base.private_dirs import HAS_LOCKS
from hilctl.base.samples import LAST_SAMPLE, BlockBatch, BlockHeader
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.locks import lock
from hilctl.recording.recovery_scan import Damage, RecoveryScan
from hilctl.recording.rewrite import Rewritten, Survey
from hilctl.recording.safe_replace import Replacement
from hilctl.recording.validation import MAX_UNIX_NS, MessageValidator, sound_blocks


@dataclass(frozen=True, slots=True)
class Recovered:
    """What became of a recording.

    Attributes:
        path: The sound file.
        original: Where the bytes as they were are kept; None where nothing could be repaired, so
            that nothing was written.
        reason: What was wrong and what is lost, in one line.
        samples: Samples in the sound file.
        added_samples: Those of them that were not in the old file.
        missing_samples: Samples known to be missing.
        damages: Stretches that could not be read.
    """

    path: Path
    original: Path | None
    reason: str
    samples: int
    added_samples: int
    missing_samples: int
    damages: tuple[Damage, ...]

    @property
    def sound(self) -> bool:
        """Whether the file was sound."""
        return self.original is None and not self.damages

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return {
            "path": str(self.path),
            "sound": self.sound,
            "original": str(self.original) if self.original else None,
            "reason": self.reason,
            "samples": self.samples,
            "added_samples": self.added_samples,
            "missing_samples": self.missing_samples,
            "damages": [str(damage) for damage in self.damages],
        }


def recover_recording(
    path: Path,
    extra: Iterable[BlockBatch] = (),
    end: Mapping[str, str] | None = None,
    *,
    events: Sequence[Event] = (),
    ended_at: int = 0,
    output: Path | None = None,
) -> Recovered:
    """Make a recording sound.

    The new file takes the place of the old one, which is kept beside it as ``NAME.torn``, with a
    number where there is one already. A sound file is left alone unless ``extra`` holds more.

    Args:
        path: The recording; nobody may have it open for recording.
        extra: Batches that were exchanged and perhaps not written, in order. Blocks whose samples
            are in the file already are left out; what is missing before the others counts as
            dropped. A block is in a file as a whole or not at all.
        end: Facts of the run's end where the file has none of its own, with ``code`` and
            ``reason``; else the code is ``recovered``.
        events: Events of the loop that were perhaps not written; added with the batches.
        ended_at: Index after the last sample that was exchanged; 0 where that is not known, and
            where no run can have got there.
        output: Put the sound file here instead, and leave the old one where it is.

    Raises:
        DataError: The file can't be read, holds nothing to recover, or lacks what is needed to add
            ``extra``.
        InputError: It is being recorded, or the sound file can't be written. Nothing has changed.
    """
    try:
        with path.open("rb") as stream:
            lock(stream, shared=True)
            survey = _survey(path, stream)
            more = list(_not_in_file(extra, survey.next_sample))
            events = [event for event in events if _is_one(event)]
            if not survey.scan.repairable and not more:
                return _left_alone(path, survey)
            layout = _check(path, survey, more)
            with closing(Replacement(path, output)) as replacement:
                saved = Rewritten(replacement.stream, survey)
                saved.copy(RecoveryScan(stream, MessageValidator()).records())
                if layout:
                    saved.add(more, events, layout)
                reason = saved.finish(end, ended_at if ended_at < LAST_SAMPLE else 0)
                if not HAS_LOCKS:
                    stream.close()
                kept = replacement.put()
    except FileNotFoundError as error:
        raise DataError(f"{error.filename or path}: no such file or folder") from None
    except FileExistsError:
        raise InputError(f"{output}: exists already: give another --output") from None
    except OSError as error:
        where = error.filename or path
        raise InputError(f"{where}: can't be recovered: {error.strerror}") from None
    return Recovered(
        path=replacement.final,
        original=kept,
        reason=reason,
        samples=saved.samples,
        added_samples=saved.added,
        missing_samples=saved.missing,
        damages=tuple(survey.scan.damages),
    )


def _survey(path: Path, stream: BinaryIO) -> Survey:
    try:
        return Survey(stream)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _is_one(event: Event) -> bool:
    """Return whether an event is one that a loop can have left in memory."""
    return 0 <= event.sample < LAST_SAMPLE and 0 <= event.time_ns <= MAX_UNIX_NS


def _left_alone(path: Path, survey: Survey) -> Recovered:
    missing, damages = survey.next_sample - survey.samples, tuple(survey.scan.damages)
    text = "sound: nothing to recover"
    if damages:
        text = f"{survey.scan.describe()}; this cannot be repaired, all else is sound"
    return Recovered(path, None, text, survey.samples, 0, missing, damages)


def _check(path: Path, survey: Survey, more: list[BlockBatch]) -> RecordingLayout | None:
    """Refuse what nothing can be made of; return how to add what is to be added."""
    if not survey.records:
        raise DataError(f"{path}: holds no whole record: there is nothing to recover")
    if not more:
        return None
    try:
        return RecordingLayout.from_facts(survey.run)
    except DataError as error:
        raise DataError(f"{path}: samples can't be added: {error}") from None


def _not_in_file(extra: Iterable[BlockBatch], next_sample: int) -> Iterator[BlockBatch]:
    """Yield the blocks from ``next_sample`` on, with the gaps before them counted anew.

    They come from memory that a dying process has left: what no loop can have written is left out.
    """
    for batch in extra:
        firsts = batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist()
        sound = sound_blocks(batch)
        rows: list[int] = []
        gaps: list[int] = []
        for row, first in enumerate(firsts):
            if first >= next_sample and sound[row]:
                rows.append(row)
                gaps.append(first - next_sample)
                next_sample = first + batch.flags.shape[1]
        if rows:
            chosen = batch.rows(np.array(rows, dtype=np.int64))
            chosen.heads[:, BlockHeader.DROPPED_BEFORE] = gaps
            yield chosen
