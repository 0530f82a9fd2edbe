"""What the first and the last bytes of a recording say of its run; samples are not looked at."""

import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Footer, McapRecord, Metadata, MetadataIndex, SummaryOffset
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.base.errors import DataError
from hilctl.base.remedy import reason
from hilctl.recording.facts import CHECKSUM_FACT, unsealed
from hilctl.recording.locks import is_being_recorded
from hilctl.recording.mcap_records import FRAME, LARGEST_BYTES, parse

_HEAD_BYTES = 8192
_TAIL_BYTES = 4096
_FOOTER_BYTES = FRAME.size + 20 + len(MAGIC)
_MOST_BEFORE = 8  # records that may stand before the facts of the run: hilctl writes a header


@dataclass(frozen=True, slots=True)
class RecordingEnds:
    """Facts of a run from both ends of its file.

    Attributes:
        run: Facts of its start.
        end: Facts of its end; empty where the file is not finished.
        state: ``finished``; ``recording`` where a run is writing to it; ``unfinished`` where it was
            cut short; ``damaged`` where a checksum of the facts is wrong or the way to them is
            lost: then facts that are not known to be right are left out. What lies between the ends
            is not known to be sound.
        problem: What is damaged; else empty.
    """

    run: Mapping[str, str]
    end: Mapping[str, str]
    state: str
    problem: str = ""


def recordings_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are named as recordings are, in the order of their names.

    A folder or a pipe of such a name is none.
    """
    return sorted(path for path in folder.glob("*.mcap") if path.is_file())


def read_ends(path: Path) -> RecordingEnds:
    """Read what a recording says of its run at its start and at its end.

    Raises:
        DataError: The file can't be read, is not an MCAP file, or does not begin with a run.
    """
    try:
        _check_is_file(path)  # first: opening a pipe waits for its writer
        with path.open("rb", buffering=0) as stream:
            return _ends(stream)
    except OSError as error:
        raise DataError(f"{path}: can't be read: {reason(error)}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _check_is_file(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode):
        raise DataError("is not a file")


def _ends(stream: FileIO) -> RecordingEnds:
    file = _Bytes(stream)
    metadata, end_metadata = _run_metadata(file), _end_metadata(file)
    run, right = unsealed("hilctl.run", metadata)
    if not right:
        return RecordingEnds({}, {}, "damaged", "metadata hilctl.run: its checksum is wrong")
    if end_metadata is not None:
        end, right = unsealed("hilctl.end", end_metadata)
        if not right:
            return RecordingEnds(run, {}, "damaged", "metadata hilctl.end: its checksum is wrong")
        if not end and CHECKSUM_FACT in metadata:  # who writes the one writes the other
            return RecordingEnds(run, {}, "damaged", "its index is damaged")
        return RecordingEnds(run, end, "finished")
    return RecordingEnds(run, {}, "recording" if is_being_recorded(stream) else "unfinished")


class _Bytes:
    """A file of which head and tail are read once."""

    def __init__(self, stream: FileIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size
        self._parts = {0: self._read(0, _HEAD_BYTES)}
        if self.size > _HEAD_BYTES:
            tail_at = self.size - _TAIL_BYTES
            self._parts[tail_at] = self._read(tail_at, _TAIL_BYTES)

    def _read(self, start: int, size: int) -> bytes:
        self._stream.seek(start)
        return self._stream.read(size)

    def at(self, start: int, size: int) -> bytes:
        """Return bytes of the file; fewer at its end, none of a place or size that can't be."""
        if not 0 <= start < self.size or not 0 < size <= LARGEST_BYTES:
            return b""
        for at, part in self._parts.items():
            if at <= start and start + size <= at + len(part):
                return part[start - at : start - at + size]
        return self._read(start, size)

    def records(self, start: int, stop: int) -> Iterator[McapRecord]:
        """Yield whole records, up to the first that is none or is of messages."""
        while start + FRAME.size <= stop:
            frame = self.at(start, FRAME.size)
            if len(frame) < FRAME.size:  # an offset that leads out of the file
                return
            opcode, length = FRAME.unpack(frame)
            start += FRAME.size
            if length > stop - start or opcode in {Opcode.CHUNK, Opcode.MESSAGE}:
                return
            record = parse(opcode, self.at(start, length))
            if record is None:
                return
            yield record
            start += length


def _run_metadata(file: _Bytes) -> Mapping[str, str]:
    if file.at(0, len(MAGIC)) != MAGIC:
        raise DataError("is not an MCAP file, or its start is lost")
    for record, _ in zip(file.records(len(MAGIC), file.size), range(_MOST_BEFORE), strict=False):
        if isinstance(record, Metadata) and record.name == "hilctl.run":
            return record.metadata
    raise DataError("holds no run of hilctl (metadata hilctl.run is missing)")


def _end_metadata(file: _Bytes) -> Mapping[str, str] | None:
    """Return the facts of the end by way of footer and index; None where those are not there."""
    footer_at = file.size - _FOOTER_BYTES
    if file.at(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        return None
    footer = next(file.records(footer_at, file.size - len(MAGIC)), None)
    if not isinstance(footer, Footer):
        return None
    found: Mapping[str, str] = {}
    for index in _metadata_indexes(file, footer.summary_offset_start or footer_at, footer_at):
        if index.name == "hilctl.end":
            record = next(file.records(index.offset, index.offset + index.length), None)
            found = record.metadata if isinstance(record, Metadata) else found
    return found


def _metadata_indexes(file: _Bytes, start: int, stop: int) -> Iterator[MetadataIndex]:
    """Yield the index of metadata by way of the offsets in a summary, however long that is."""
    for group in file.records(start, stop):
        if isinstance(group, SummaryOffset) and group.group_opcode == Opcode.METADATA_INDEX:
            end = min(group.group_start + group.group_length, stop)
            for index in file.records(group.group_start, end):
                if isinstance(index, MetadataIndex):
                    yield index
