"""What the first and the last bytes of a recording say of its run; samples are not looked at."""

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Footer, Metadata, MetadataIndex, SummaryOffset
from mcap.writer import MCAP0_MAGIC as MAGIC

from hilctl.base.errors import DataError
from hilctl.base.files import reason
from hilctl.recording.locks import is_being_recorded
from hilctl.recording.mcap_records import FRAME, records_from
from hilctl.recording.metadata_keys import CHECKSUM_FACT, unsealed

_BUFFER_BYTES = 4096
_FOOTER_BYTES = FRAME.size + 20
_MOST_BEFORE = 8  # records that may stand before the facts of the run: hilctl writes a header


@dataclass(frozen=True, slots=True)
class RunSummary:
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


def read_ends(path: Path) -> RunSummary:
    """Read what a recording says of its run at its start and at its end.

    Raises:
        DataError: The file can't be read, is not an MCAP file, or does not begin with a run.
    """
    try:
        _check_is_file(path)  # first: opening a pipe waits for its writer
        with path.open("rb", _BUFFER_BYTES) as stream:
            return _ends(stream)
    except OSError as error:
        raise DataError(f"{path}: can't be read: {reason(error)}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _check_is_file(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode):
        raise DataError("is not a file")


def _ends(stream: BinaryIO) -> RunSummary:
    size = stream.seek(0, os.SEEK_END)
    metadata, end_metadata = _run_metadata(stream, size), _end_metadata(stream, size)
    run, right = unsealed("hilctl.run", metadata)
    if not right:
        return RunSummary({}, {}, "damaged", "metadata hilctl.run: its checksum is wrong")
    if end_metadata is not None:
        end, right = unsealed("hilctl.end", end_metadata)
        if not right:
            return RunSummary(run, {}, "damaged", "metadata hilctl.end: its checksum is wrong")
        if not end and CHECKSUM_FACT in metadata:  # who writes the one writes the other
            return RunSummary(run, {}, "damaged", "its index is damaged")
        return RunSummary(run, end, "finished")
    return RunSummary(run, {}, "recording" if is_being_recorded(stream) else "unfinished")


def _run_metadata(stream: BinaryIO, size: int) -> Mapping[str, str]:
    stream.seek(0)
    if stream.read(len(MAGIC)) != MAGIC:
        raise DataError("is not an MCAP file, or its start is lost")
    for record in islice(records_from(stream, len(MAGIC), size), _MOST_BEFORE):
        if isinstance(record, Metadata) and record.name == "hilctl.run":
            return record.metadata
    raise DataError("holds no run of hilctl (metadata hilctl.run is missing)")


def _end_metadata(stream: BinaryIO, size: int) -> Mapping[str, str] | None:
    """Return the facts of the end, found by footer and index; None if those are missing."""
    footer_at = size - _FOOTER_BYTES - len(MAGIC)
    stream.seek(max(0, size - len(MAGIC)))
    if footer_at < 0 or stream.read() != MAGIC:
        return None
    footer = next(records_from(stream, footer_at, footer_at + _FOOTER_BYTES), None)
    if not isinstance(footer, Footer):
        return None
    found: Mapping[str, str] = {}
    # By the offsets in the summary: its index of chunks may be long.
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
