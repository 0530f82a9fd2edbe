"""Records of an identification, read from recordings and text tables."""

import logging
from collections.abc import Collection, Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple, cast, get_args

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.base.table import Column, RowError, Table, open_table
from hilctl.base.types import F64, I64, CommandUnit
from hilctl.lab.identify.data.cycles import find_cycles, loops_from_pieces
from hilctl.lab.identify.data.data_faults import correlation, table_fault
from hilctl.lab.identify.data.records import History, Record, from_known_state
from hilctl.lab.identify.settings import IdentifySettings, TableSettings
from hilctl.recording.reader import RecordingStream
from hilctl.recording.recording import Recording

_log = logging.getLogger(__name__)

SLOWEST_HZ, SLOWEST_ASSUMED_HZ = 10.0, 100.0  # sample rates below which s is in doubt, if assumed
SMALLEST_UM = 0.5  # stroke below which um is in doubt
FOLLOWS = 0.5  # correlation with the command of a displacement that is more than noise
UNEVEN = 0.5  # maximum deviation of a time step from the median, due to rounding in text


class TableRecord(NamedTuple):
    """A record from a table."""

    history: History  # the record
    unit: CommandUnit | None  # unit of its command; None if the table has none
    understood: str  # columns and units in words


def read_table(path: Path, settings: TableSettings) -> TableRecord:
    """Read command and displacement from a table, see :func:`hilctl.base.table.open_table`.

    Raise DataError if a column is unknown or has the wrong unit, a value is not a finite number
    (names ``file:line``), time steps are uneven, more than 1 % of the rows are missing, or settings
    are missing or contradict each other.
    """
    table = open_table(path, settings.skip_rows)
    command, output, *times = wanted = _columns(table, settings)
    unit = settings.unit or table.unit(command)[0]
    if unit not in get_args(CommandUnit):
        unit = ""
    command_scale = _scale(table, command, unit, "--command-scale", settings.command_scale)
    scale = _scale(table, output, "um", "--displacement-scale", settings.displacement_scale)
    parts = [f"command {_called(table, command, unit)}"]
    parts += [f"displacement {_called(table, output, 'um')}"]
    per_s = 1.0
    for time in times:
        per_s = _scale(table, time, "s", "--time-column", None)
        parts.insert(0, f"time {_called(table, time, 's')}")
    try:
        found = table.read(wanted, settings.first_row, settings.last_row, gaps=output)
        rate_hz, row = settings.rate_hz, np.arange(found.lines.size)
        if rate_hz is None:
            rate_hz, row = found.sample_grid(2, UNEVEN, per_s, MOST_MISSING)
    except RowError as error:
        raise error.without("--set table.") from None
    every = np.arange(row[-1] + 1)
    missing = np.setdiff1d(every, row[np.isfinite(found.values[1])])
    _, displacement_um = _filled(path, row, found.values[0], found.values[1] * scale, every)
    # Not held, as in skipped ticks: the device moved on when the logger lost a row.
    command = np.interp(every, row, found.values[0] * command_scale)
    rows = settings.first_row + np.searchsorted(row, every)
    signals = command, displacement_um
    history = History(path.name, *signals, rate_hz, settings.ignore or 0, missing, rows)
    if per_s == 1.0 and times:
        named = table.unit(times[0])[0] == "s"
        _check_rate(path, rate_hz, SLOWEST_HZ if named else SLOWEST_ASSUMED_HZ)
    if scale == 1.0 and settings.displacement_scale is None:
        _check_stroke(path, history)
    size = f"{found.lines.size} rows at {rate_hz:.6g} Hz"
    understood = f"{path.name}: {', '.join(parts)}; {size}"
    return TableRecord(history, cast("CommandUnit | None", unit or None), understood)


def _check_rate(path: Path, rate_hz: float, slowest_hz: float) -> None:
    """Raise DataError if a time column is probably in ms."""
    if rate_hz < slowest_hz:
        raise DataError(
            f"{path}: {rate_hz:.4g} samples per second are few: instead of --time-column, set "
            f"--rate-hz {1e3 * rate_hz:.6g} if the time is in ms, or --rate-hz {rate_hz:.6g} if it "
            "is in s"
        )


def _check_stroke(path: Path, history: History) -> None:
    """Raise DataError if a displacement is probably in mm."""
    move_um = float(np.ptp(history.displacement_um))
    if move_um < SMALLEST_UM and abs(correlation(history.command, history)) > FOLLOWS:
        raise DataError(
            f"{path}: the displacement moves by {move_um:.3g} µm only: set --displacement-scale "
            "1000 if it is in mm, or --displacement-scale 1 if it is in µm"
        )


def _columns(table: Table, settings: TableSettings) -> list[int]:
    """Return the columns of command, displacement and, without a rate, time.

    Raise DataError with the option of each column that is unknown.
    """
    named, shown = settings.command_column, settings.displacement_column
    found = {
        "--command-column": _column(
            table, named, "--command-column", {"current_a", "drive_v"}, "A", "V"
        ),
        "--displacement-column": _column(
            table, shown, "--displacement-column", {"displacement_um"}, "um"
        ),
    }
    if settings.rate_hz is None:
        time = _column(table, settings.time_column, "--time-column", {"t_s"}, "s")
        found["--time-column or --rate-hz"] = time
    elif settings.time_column is not None:
        raise DataError(f"{table.path}: set either --time-column or --rate-hz (got both)")
    missing = ", ".join(option for option, at in found.items() if at is None)
    if missing:
        rule = f"set {missing}, by name or number"
        raise DataError(f"{table.path}: {rule}; its columns are {table.listed}")
    columns = [at for at in found.values() if at is not None]
    if columns[0] == columns[1]:
        rule = f"command and displacement are both column {table.names[columns[0]]}"
        raise DataError(f"{table.path}: {rule}: set --command-column and --displacement-column")
    return columns


def _column(
    table: Table, column: Column | None, option: str, usual: Collection[str], *units: str
) -> int | None:
    if column is None:
        return table.only(usual, *units)
    try:
        return table.index(column)
    except DataError as error:
        raise DataError(f"{error}; choose one with {option}") from None


def _scale(table: Table, at: int, unit: str, option: str, given: float | None) -> float:
    """Return the factor from a column's numbers to a unit; raise DataError if it is unknown."""
    base, factor = table.unit(at)
    if given is not None:
        return factor * given
    if base in {"", unit}:
        return factor
    rule = f"is in {base}, not in {unit or 'A or V'}: set {option}"
    if option.endswith("scale"):
        rule += f", in {unit or 'A or V'} per {base}"
    raise DataError(f"{table.path}: column {table.names[at]} {rule}")


def _called(table: Table, at: int, unit: str) -> str:
    base, name = table.unit(at)[0], table.bare_name(at)
    return f"{name} [{base}]" if base else f"{name} [{unit or 'unit unknown'}, assumed]"


MOST_WHOLE = 20_000_000
"""Maximum samples of a run that is fitted as a whole: about 100 bytes and 10 us per sample."""


class LoadedRecords(NamedTuple):
    """Records of files."""

    records: list[Record]  # loops and histories
    unit: CommandUnit | None  # command unit; None if the tables do not have one
    understood: list[str]  # columns and units of each table in words


def load_records(
    paths: Sequence[Path], settings: IdentifySettings, lag_samples: int
) -> LoadedRecords:
    """Read recordings (``.mcap``) and tables, whose displacements lag, as records."""
    records: list[Record] = []
    faults: list[str] = []
    known: list[str] = []
    understood: list[str] = []
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
            history, unit, text = _from_table(path, settings, lag_samples)
            if fault := table_fault(history, start=settings.table.ignore is None):
                faults.append(f"{path}: {fault}")
            understood.append(text)
            units |= {unit} if unit else set()
            records.append(history if settings.whole else find_cycles(history, settings.points))
        elif settings.whole:
            history = history_from_pieces(chain([first], pieces))
            at_rest = first.run.get("simulated") == "true"
            records.append(history if at_rest else from_known_state(history))
        else:
            # Excluded segments need not have a steady cycle.
            chosen = kept if left_out else ()
            records += loops_from_pieces(chain([first], pieces), settings.points, chosen)
    if faults:
        raise DataError("\n".join(faults))
    if len(units) > 1:
        raise InputError("recordings with commands in A and in V cannot be fitted together")
    _check_left_out(left_out, known)
    if known and not records:
        raise InputError("--leave-out excludes all records")
    return LoadedRecords(records, next(iter(units), None), understood)


def _check_left_out(left_out: Iterable[str], known: Sequence[str]) -> None:
    for label in left_out:
        if not any(each.startswith(label) for each in known):
            raise InputError(f"--leave-out {label!r}: unknown label; known are {', '.join(known)}")


def _from_table(path: Path, settings: IdentifySettings, lag_samples: int) -> TableRecord:
    """Read a table whose displacement lags; a whole history is evaluated from a known state."""
    read = read_table(path, settings.table)
    history, text = read.history.without_lag(lag_samples), read.understood
    if settings.whole and (known := from_known_state(history)) is not history:
        begin_s = known.time_s[known.ignore]
        text += f"; not evaluated before {begin_s:.3g} s, because its state is unknown until then"
        history = known
    return TableRecord(history, read.unit, text)


MOST_MISSING = 0.01  # share of samples


def without_gaps(
    recording: Recording,
    start: int,
    stop: int,
    held: str = "command",
    interpolated: str = "displacement_um",
) -> tuple[F64, F64]:
    """Return every value of two columns in [start, stop), with gaps filled.

    The command is held, as the device holds its output in skipped ticks. The displacement in um is
    interpolated: it approaches the value of the held command, which the next sample still shows.
    Raise DataError if more than 1 % of the samples are missing or have no displacement.
    """
    samples = recording.samples.part(start, stop)
    signals = samples.index, samples.column(held), samples.column(interpolated)
    return _filled(recording.path, *signals, np.arange(start, stop))


def _filled(
    path: Path, index: I64, command: F64, displacement_um: F64, wanted: I64
) -> tuple[F64, F64]:
    good = np.isfinite(displacement_um)
    missing = wanted.size - np.count_nonzero(good)
    if missing > MOST_MISSING * wanted.size:
        rule = f"{missing} of {wanted.size} samples are missing or have no displacement"
        raise DataError(f"{path}: {rule}: check late ticks and the sensor")
    if missing:
        text = "the displacement is interpolated, and not evaluated"
        _log.warning("%s: %d of %d samples are missing: %s", path, missing, wanted.size, text)
    last = np.maximum(np.searchsorted(index, wanted, side="right") - 1, 0)
    filled_um = np.interp(wanted, index[good], displacement_um[good])
    return np.ascontiguousarray(command[last]), filled_um


def history_from_pieces(pieces: Iterable[Recording]) -> History:
    """Return the whole waveform of a run from rest, without the ramp at its end.

    Skipped samples are filled, see :func:`without_gaps`. Raise DataError if too many are missing,
    the command of a missing one is unknown, the run is too long, or it begins with a ramp from
    another output, so that its initial state is unknown.
    """
    indices: list[I64] = []
    command: list[F64] = []
    displacement_um: list[F64] = []
    conditioned = begins_at = next_sample = 0
    ramped = lost = False
    for piece in pieces:
        samples = piece.samples
        condition = (samples.flags & Flag.CONDITION.value) != 0
        if condition.any() and not conditioned:  # conditioning erases earlier motion
            samples = samples.rows(slice(int(np.argmax(condition)), None))
            indices, command, displacement_um = [], [], []
            begins_at = next_sample = int(samples.index[0])
            ramped = lost = False
        if condition.any():  # sets the state; not evaluated
            conditioned = int(piece.samples.index[condition][-1]) + 1 - begins_at
        rows = (samples.flags & Flag.RAMP.value) == 0
        ramped |= bool(rows.size) and samples.index[0] == 0 and not rows[0]
        index = samples.index[rows]
        gaps = np.diff(index, prepend=next_sample - 1) > 1
        # In other gaps samples were output but not recorded.
        lost |= bool(np.any(gaps & ((samples.flags[rows] & Flag.AFTER_SKIPPED.value) == 0)))
        next_sample = int(index[-1]) + 1 if index.size else next_sample
        indices.append(index)
        command.append(samples.command[rows])
        displacement_um.append(samples.displacement_um[rows])
        if next_sample - begins_at > MOST_WHOLE:
            raise DataError(
                f"{piece.path}: has more than {MOST_WHOLE:,} samples, too many to be fitted as a "
                "whole. Omit --whole to use its steady cycles, or record a shorter run"
            )
    if ramped:
        raise DataError(
            f"{piece.path}: begins with a ramp, so the actuator was not at rest. Omit --whole to "
            "use its steady cycles"
        )
    if next_sample == begins_at:
        raise DataError(f"{piece.path}: contains no samples of the waveform")
    if lost:
        raise DataError(
            f"{piece.path}: samples are missing whose command is unknown, so it cannot be fitted "
            "as a whole. Omit --whole to use its steady cycles"
        )
    signals = np.concatenate(indices), _joined(command), _joined(displacement_um)
    filled = _filled(piece.path, *signals, np.arange(begins_at, next_sample))
    recorded = signals[0] - begins_at
    held = np.setdiff1d(np.arange(next_sample - begins_at), recorded, assume_unique=True)
    return History(piece.path.name, *filled, piece.sample_rate_hz, conditioned, held)


def _joined(parts: list[F64]) -> F64:
    """Return one array of all parts, and empty the list to free memory."""
    joined = np.concatenate(parts)
    parts.clear()
    return joined
