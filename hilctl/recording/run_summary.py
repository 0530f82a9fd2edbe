"""Facts of a run from the start and the end of its file, without reading samples."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Metadata, MetadataIndex, SummaryOffset
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.base.errors import DataError
from hilctl.base.files import is_folder, open_binary, reason
from hilctl.recording.mcap_records import footer_of, records_from
from hilctl.recording.metadata_keys import CHECKSUM_FACT, unsealed
from hilctl.recording.recording_files import is_being_recorded

_BUFFER_BYTES = 4096
_MOST_BEFORE = 8  # records before the facts of the run; hilctl writes a header


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Facts of a run from both ends of its file.

    Attributes:
        end: Facts of the run's end; empty if the file is not finished.
        state: ``finished``, ``recording`` (a run is writing to it), ``unfinished`` (truncated) or
            ``damaged`` (a checksum of the facts or the index is wrong; unverified facts are
            omitted). Damage between the ends is not detected.
    """

    run: Mapping[str, str]
    end: Mapping[str, str]
    state: str
    problem: str = ""


def recordings_in(folder: Path) -> list[Path]:
    """Return the regular files of a folder with the suffix of recordings, sorted by name."""
    paths = folder.glob("*.mcap") if is_folder(folder) else ()
    return sorted(path for path in paths if path.is_file())


def read_ends(path: Path) -> RunSummary:
    """Read the facts of a run from both ends of its recording; raise DataError if it has none."""
    try:
        with open_binary(path, _BUFFER_BYTES) as stream:
            return _ends(stream)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {reason(error)}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _ends(stream: BinaryIO) -> RunSummary:
    size = stream.seek(0, os.SEEK_END)
    metadata, end_metadata = _run_metadata(stream, size), _end_metadata(stream)
    run, right = unsealed("hilctl.run", metadata)
    if not right:
        return RunSummary({}, {}, "damaged", "metadata hilctl.run: its checksum is wrong")
    if end_metadata is not None:
        end, right = unsealed("hilctl.end", end_metadata)
        if not right:
            return RunSummary(run, {}, "damaged", "metadata hilctl.end: its checksum is wrong")
        if not end and CHECKSUM_FACT in metadata:  # a file with one checksum has both
            return RunSummary(run, {}, "damaged", "its index is damaged")
        return RunSummary(run, end, "finished")
    return RunSummary(run, {}, "recording" if is_being_recorded(stream) else "unfinished")


def _run_metadata(stream: BinaryIO, size: int) -> Mapping[str, str]:
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        raise DataError("is not an MCAP file, or its start is missing")
    for record in islice(records_from(stream, len(MAGIC), size), _MOST_BEFORE):
        if isinstance(record, Metadata) and record.name == "hilctl.run":
            return record.metadata
    raise DataError("holds no run of hilctl (metadata hilctl.run is missing)")


def _end_metadata(stream: BinaryIO) -> Mapping[str, str] | None:
    """Return the facts of the end, located by footer and index; None if these are missing."""
    if (place := footer_of(stream)) is None:
        return None
    footer_at, footer = place
    found: Mapping[str, str] = {}
    # The summary offsets skip the index of chunks, which may be long.
    start = footer.summary_offset_start or footer_at
    for group in records_from(stream, start, footer_at):
        if isinstance(group, SummaryOffset) and group.group_opcode == Opcode.METADATA_INDEX:
            end = min(group.group_start + group.group_length, footer_at)
            for index in records_from(stream, group.group_start, end):
                if isinstance(index, MetadataIndex) and index.name == "hilctl.end":
                    stop = index.offset + index.length
                    record = next(records_from(stream, index.offset, stop), None)
                    found = record.metadata if isinstance(record, Metadata) else found
    return found
