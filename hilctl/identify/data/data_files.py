"""Records of an identification, read from recordings and text tables."""

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from hilctl.base.csv_table import Column, TextTable
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.base.types import F64, CommandUnit
from hilctl.identify.data.cycles import find_cycles, loops_from_pieces
from hilctl.identify.data.records import History, Record
from hilctl.identify.settings import IdentifySettings
from hilctl.recording.reader import RecordingStream
from hilctl.recording.recording import Recording

UNEVEN = 0.5  # maximum deviation of a time step from the median, due to rounding in text


def read_table(
    path: Path,
    command_column: Column,
    displacement_column: Column,
    *,
    time_column: Column | None = None,
    rate_hz: float | None = None,
    rows: tuple[int, int | None] = (0, None),
    ignore: int = 0,
) -> History:
    """Read command and displacement from a text table, see :mod:`hilctl.base.csv_table`.

    Args:
        path: The file.
        command_column: Command in the device's unit.
        displacement_column: Displacement in um.
        time_column: Time in s, evenly spaced; or set ``rate_hz``.
        rate_hz: Samples per second; or set ``time_column``.
        rows: First data row and end, counted from 0; None for all.
        ignore: Samples at the start of these rows that are simulated but not evaluated.

    Raises:
        InputError: The file can't be read.
        DataError: A column is unknown, a value is not a finite number (names ``file:line``), time
            steps are uneven, or not exactly one of ``time_column`` and ``rate_hz`` is set.
    """
    if (time_column is None) == (rate_hz is None):
        given = "neither" if rate_hz is None else "both"
        raise DataError(f"{path}: set either table.time_column or table.rate_hz (got {given})")
    wanted = [command_column, displacement_column]
    wanted += [] if time_column is None else [time_column]
    table = TextTable(path)
    found = table.read([table.index(column) for column in wanted], rows[0] + 1, rows[1])
    if rate_hz is None:
        rate_hz = found.sample_rate_hz(2, UNEVEN)
    return History(path.name, found.values[0].copy(), found.values[1].copy(), rate_hz, ignore)


MOST_WHOLE = 20_000_000
"""Maximum samples of a run that is fitted as a whole: about 100 bytes and 10 us per sample."""


def load_records(
    paths: Sequence[Path], settings: IdentifySettings, lag_samples: int
) -> tuple[list[Record], CommandUnit | None]:
    """Read recordings and text tables as records.

    Args:
        paths: Recordings (``.mcap``) and text tables.
        settings: Points per loop, and how files are read.
        lag_samples: Lag of the displacements of tables.

    Returns:
        Loops and histories, and the command unit of the recordings (None if all are tables).

    Raises:
        DataError: A file can't be used.
        InputError: Recordings of devices driven in A and in V are mixed.
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
            records.append(_from_table(path, settings, lag_samples))
        elif settings.whole:
            records.append(history_from_pieces(chain([first], pieces)))
        else:
            # Excluded segments need not have a steady cycle.
            chosen = kept if left_out else ()
            records += loops_from_pieces(chain([first], pieces), settings.points, chosen)
    if len(units) > 1:
        raise InputError("recordings with commands in A and in V can't be fitted together")
    _check_left_out(settings.leave_out, known, records)
    return records, next(iter(units), None)


def _check_left_out(labels: Sequence[str], known: Sequence[str], kept: Sequence[Record]) -> None:
    """Raise InputError if a label is unknown, or no record is left."""
    for label in labels:
        if not any(each.startswith(label) for each in known):
            raise InputError(f"--leave-out {label!r}: unknown label; known are {', '.join(known)}")
    if known and not kept:
        raise InputError("--leave-out excludes all records")


def history_from_recording(recording: Recording) -> History:
    """Return the whole waveform of a run, see :func:`history_from_pieces`."""
    return history_from_pieces([recording])


def history_from_pieces(pieces: Iterable[Recording]) -> History:
    """Return the whole waveform of a run from rest, without the ramp at its end.

    Args:
        pieces: The run, see :class:`hilctl.recording.reader.RecordingStream`.

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
        _check_length(piece, size)
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


def _check_length(recording: Recording, size: int) -> None:
    if size > MOST_WHOLE:
        raise DataError(
            f"{recording.path}: has more than {MOST_WHOLE:,} samples, too many to be fitted as a "
            "whole. Omit --whole to use its steady cycles, or record a shorter run"
        )


def _from_table(path: Path, settings: IdentifySettings, lag_samples: int) -> Record:
    table = settings.table
    history = read_table(
        path,
        table.command_column,
        table.displacement_column,
        time_column=table.time_column,
        rate_hz=table.rate_hz,
        rows=(table.first_row - 1, table.last_row),
        ignore=table.ignore,
    ).without_lag(lag_samples)
    return history if settings.whole else find_cycles(history, settings.points)
