"""Records of an identification, read from recordings and text tables."""

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from hilctl.base.csv_table import TextTable
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.base.types import F64, CommandUnit
from hilctl.identify.data.cycles import find_cycles, loops_from_pieces
from hilctl.identify.data.records import History, Record
from hilctl.identify.settings import IdentifySettings, TableSettings
from hilctl.recording.reader import RecordingStream
from hilctl.recording.recording import Recording

UNEVEN = 0.5  # maximum deviation of a time step from the median, due to rounding in text


def read_table(path: Path, table: TableSettings) -> History:
    """Read command and displacement from a text table, see :mod:`hilctl.base.csv_table`.

    Raises:
        InputError: The file can't be read.
        DataError: A column is unknown, a value is not a finite number (names ``file:line``), time
            steps are uneven, or not exactly one of ``time_column`` and ``rate_hz`` is set.
    """
    if (table.time_column is None) == (table.rate_hz is None):
        given = "neither" if table.rate_hz is None else "both"
        raise DataError(f"{path}: set either table.time_column or table.rate_hz (got {given})")
    wanted = [table.command_column, table.displacement_column]
    wanted += [] if table.time_column is None else [table.time_column]
    text = TextTable(path)
    found = text.read([text.index(column) for column in wanted], table.first_row, table.last_row)
    command, displacement_um, *_ = found.values
    rate_hz = table.rate_hz or found.sample_rate_hz(2, UNEVEN)
    return History(path.name, command.copy(), displacement_um.copy(), rate_hz, table.ignore)


MOST_WHOLE = 20_000_000
"""Maximum samples of a run that is fitted as a whole: about 100 bytes and 10 us per sample."""


def load_records(
    paths: Sequence[Path], settings: IdentifySettings, lag_samples: int
) -> tuple[list[Record], CommandUnit | None]:
    """Read recordings (``.mcap``) and text tables, whose displacements lag, as records.

    Returns:
        Loops and histories, and the command unit of the recordings (None if all are tables).

    Raises:
        DataError: A file can't be used.
        InputError: Commands in A and in V are mixed, or ``leave_out`` names none or all.
    """
    records: list[Record] = []
    known: list[str] = []
    units: set[CommandUnit] = set()
    left_out = settings.leave_out
    for path in paths:
        pieces = iter(RecordingStream(path)) if path.suffix.lower() == ".mcap" else iter(())
        first = next(pieces, None)
        loops = first is not None and not settings.whole and first.segments
        labels = [segment.label for segment in loops] if loops else [path.name]
        known += labels
        kept = [label for label in labels if not label.startswith(left_out)]
        if first is not None:
            units.add(first.command_unit)
        if not kept:
            continue
        if first is None:
            history = read_table(path, settings.table).without_lag(lag_samples)
            records.append(history if settings.whole else find_cycles(history, settings.points))
        elif settings.whole:
            records.append(history_from_pieces(chain([first], pieces)))
        else:
            # Excluded segments need not have a steady cycle.
            chosen = kept if left_out else ()
            records += loops_from_pieces(chain([first], pieces), settings.points, chosen)
    if len(units) > 1:
        raise InputError("recordings with commands in A and in V can't be fitted together")
    for label in left_out:
        if not any(each.startswith(label) for each in known):
            raise InputError(f"--leave-out {label!r}: unknown label; known are {', '.join(known)}")
    if known and not records:
        raise InputError("--leave-out excludes all records")
    return records, next(iter(units), None)


def history_from_pieces(pieces: Iterable[Recording]) -> History:
    """Return the whole waveform of a run from rest, without the ramp at its end.

    Raises:
        DataError: Samples are missing or have no displacement, the run is too long, or it begins
            with a ramp from another output, so that its initial state is unknown.
    """
    command: list[F64] = []
    displacement_um: list[F64] = []
    conditioned = size = begins_at = 0
    ramped = broken = False
    for piece in pieces:
        samples = piece.samples
        condition = (samples.flags & Flag.CONDITION.value) != 0
        if condition.any() and not conditioned:  # conditioning erases what came before
            samples = samples.rows(slice(int(np.argmax(condition)), None))
            command, displacement_um, size, begins_at = [], [], 0, int(samples.index[0])
            ramped = broken = False
        conditioned += int(np.count_nonzero(condition))  # sets the state; not evaluated
        rows = (samples.flags & Flag.RAMP.value) == 0
        ramped |= bool(rows.size) and samples.index[0] == 0 and not rows[0]
        index = samples.index[rows]
        broken |= not np.array_equal(index, begins_at + size + np.arange(index.size))
        command.append(samples.command[rows])
        displacement_um.append(samples.displacement_um[rows])
        size += index.size
        if size > MOST_WHOLE:
            raise DataError(
                f"{piece.path}: has more than {MOST_WHOLE:,} samples, too many to be fitted as a "
                "whole. Omit --whole to use its steady cycles, or record a shorter run"
            )
    if ramped:
        raise DataError(
            f"{piece.path}: begins with a ramp, so the actuator was not at rest. Omit --whole to "
            "use its steady cycles"
        )
    broken |= not all(np.isfinite(each).all() for each in displacement_um)
    if broken or not size:
        raise DataError(
            f"{piece.path}: samples are missing, so it can't be fitted as a whole. "
            "Omit --whole to use its steady cycles"
        )
    label, rate_hz = piece.path.name, piece.sample_rate_hz
    return History(label, _joined(command), _joined(displacement_um), rate_hz, conditioned)


def _joined(parts: list[F64]) -> F64:
    """Return one array of all parts, and empty the list to free memory."""
    joined = np.concatenate(parts)
    parts.clear()
    return joined
