"""Waveforms from files: CSV, NPY or MCAP, resampled only where the experiment says so."""

from pathlib import Path

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import InputError
from hilctl.waveforms.shapes import check_length
from hilctl.waveforms.spec import FileWaveform

_RATE_TOLERANCE = 1e-6


def read_samples(w: FileWaveform, sample_rate_hz: float, folder: Path) -> tuple[F64, float]:
    """Read a waveform and bring it to the run's sample rate.

    Args:
        w: What to read.
        sample_rate_hz: The run's samples a second.
        folder: Folder that ``w.path`` is relative to.

    Returns:
        float64[n], the samples in the waveform's unit, and the period in samples (0.0 where it
        does not repeat).

    Raises:
        InputError: The file, column or a row is missing, a value is not finite, its rate is not
            known, or it differs from the run's and ``resample`` is ``refuse``.
    """
    path = folder / w.path
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    raw, own_rate_hz = _read(w, path)
    last_row = raw.size if w.last_row is None else w.last_row
    if last_row > raw.size or last_row <= w.first_row:
        raise InputError(
            f"{path}: needs at least two rows from first_row to last_row, and has {raw.size}: "
            f"{w.first_row} to {last_row}"
        )
    raw = raw[w.first_row - 1 : last_row]
    bad = np.flatnonzero(~np.isfinite(raw))
    if bad.size:
        row = w.first_row + int(bad[0])
        raise InputError(f"{path}: row {row}: value must be finite, got {raw[bad[0]]}")
    rate_hz = _file_rate(w, path, own_rate_hz)
    values = w.offset + w.scale * _resampled(w, path, raw, rate_hz, sample_rate_hz)
    period = 0.0 if w.period_s is None else w.period_s * sample_rate_hz
    return values, period


def _file_rate(w: FileWaveform, path: Path, own_rate_hz: float | None) -> float:
    if own_rate_hz is None and w.file_rate_hz is None:
        raise InputError(f"{path}: holds no time column t_s: give file_rate_hz")
    if own_rate_hz is not None and w.file_rate_hz is not None:
        difference = abs(own_rate_hz / w.file_rate_hz - 1.0)
        if difference > _RATE_TOLERANCE:
            raise InputError(
                f"{path}: its own time says {own_rate_hz:.10g} Hz, "
                f"file_rate_hz says {w.file_rate_hz:.10g} Hz"
            )
    return float(own_rate_hz or w.file_rate_hz or 0.0)


def _resampled(w: FileWaveform, path: Path, raw: F64, rate_hz: float, sample_rate_hz: float) -> F64:
    if abs(rate_hz / sample_rate_hz - 1.0) <= _RATE_TOLERANCE:
        return raw
    if w.resample == "refuse":
        raise InputError(
            f"{path}: sampled at {rate_hz:.10g} Hz, the run at {sample_rate_hz:.10g} Hz: "
            "set resample to linear or cubic, or sample_rate_hz to the file's"
        )
    t_file = np.arange(raw.size) / rate_hz
    check_length(float(t_file[-1]) * sample_rate_hz)
    n = int(t_file[-1] * sample_rate_hz + 1e-9) + 1
    t = np.arange(n) / sample_rate_hz
    if w.resample == "linear":
        return np.interp(t, t_file, raw)
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(t_file, raw)(t), dtype=np.float64)


def _read(w: FileWaveform, path: Path) -> tuple[F64, float | None]:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return _read_npy(w, path)
    if suffix == ".mcap":
        return _read_mcap(w, path)
    return _read_text(w, path)


def _read_npy(w: FileWaveform, path: Path) -> tuple[F64, float | None]:
    try:
        table = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError):
        raise InputError(f"{path}: is not a whole NumPy file (.npy) of numbers") from None
    if not (isinstance(table, np.ndarray) and table.dtype.kind in "fiu" and table.ndim in (1, 2)):
        raise InputError(f"{path}: must hold a one- or two-dimensional array of numbers")
    if table.size == 0:
        raise InputError(f"{path}: holds no data")
    columns = table.reshape(table.shape[0], -1).astype(np.float64).T
    names = [str(i + 1) for i in range(len(columns))]
    return columns[_column(w, path, names)].copy(), None


def _read_text(w: FileWaveform, path: Path) -> tuple[F64, float | None]:
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets put a byte-order mark first
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror}") from None
    lines = [line for line in text.splitlines() if line.strip()]
    rows = [line for line in lines if not line.startswith("#")]
    first = rows[0] if rows else ""
    delimiter = next((d for d in (",", ";", "\t") if d in first), None)
    names = _cells(first, delimiter)
    if all(_is_number(name) for name in names):
        comments = [_cells(line[1:], delimiter) for line in lines if line.startswith("#")]
        numbers = [str(i + 1) for i in range(len(names))]
        names = next((cells for cells in comments if len(cells) == len(names)), numbers)
    else:
        rows = rows[1:]
    table = _numbers(path, rows, delimiter, len(names))
    rate_hz = _rate_of_time(path, table[:, names.index("t_s")]) if "t_s" in names else None
    return np.ascontiguousarray(table[:, _column(w, path, names)]), rate_hz


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(delimiter)]


def _numbers(path: Path, rows: list[str], delimiter: str | None, width: int) -> F64:
    """Return float64[rows, width], or say which row is not ``width`` numbers."""
    if not rows:
        raise InputError(f"{path}: holds no data")
    try:
        table = np.loadtxt(rows, delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape[1] == width:
        return table
    for number, row in enumerate(rows, start=1):
        cells = _cells(row, delimiter)
        if len(cells) != width or not all(_is_number(cell) for cell in cells):
            shown = row if len(row) <= 60 else row[:57] + "..."
            raise InputError(f"{path}: row {number}: must be {width} numbers, got {shown!r}")
    raise InputError(f"{path}: is not a table of {width} columns of numbers")


def _read_mcap(w: FileWaveform, path: Path) -> tuple[F64, float | None]:
    from hilctl.recording.reader import read

    recording = read(path)
    if np.any(np.diff(recording.samples.index) != 1):
        raise InputError(f"{path}: samples are missing in it, a waveform needs every one")
    names = ["reference_um", "displacement_um", "command", "wanted"]
    values = getattr(recording.samples, names[_column(w, path, names)])
    return np.array(values, dtype=np.float64), recording.sample_rate_hz


def _column(w: FileWaveform, path: Path, names: list[str]) -> int:
    if w.column is None:
        if len(names) == 1:
            return 0
        raise InputError(f"{path}: has several columns: set column to one of {names}")
    if isinstance(w.column, int) and 1 <= w.column <= len(names):
        return w.column - 1
    if w.column in names:
        return names.index(str(w.column))
    raise InputError(f"{path}: has no column {w.column!r}: known are {names}")


def _rate_of_time(path: Path, t_s: F64) -> float:
    steps = np.diff(t_s)
    if steps.size == 0 or not steps.min() > 0.0:
        raise InputError(f"{path}: column t_s must rise from row to row")
    step_s = float(np.median(steps))
    if float(np.max(np.abs(steps - step_s))) > 0.01 * step_s:
        row = int(np.argmax(np.abs(steps - step_s))) + 2
        raise InputError(f"{path}: column t_s must be evenly spaced: it is not at row {row}")
    return (t_s.size - 1) / float(t_s[-1] - t_s[0])


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
