"""Waveforms from CSV, NPY and MCAP files, resampled on request."""

from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.base.csv_table import MAX_COLUMNS, TextTable, check_rows, column_index
from hilctl.base.errors import InputError
from hilctl.base.files import no_such_file, reason
from hilctl.base.segments import SHORTEST_PERIOD
from hilctl.base.types import F64
from hilctl.waveforms.shapes import check_length
from hilctl.waveforms.spec import FileWaveform

_RATE_TOLERANCE = 1e-6
_TIME_TOLERANCE = 0.01  # largest deviation of a step from the median


def read_samples(w: FileWaveform, sample_rate_hz: float, folder: Path) -> tuple[F64, float]:
    """Read a waveform at the run's sample rate.

    Returns:
        float64[n], the samples in the waveform's unit, and the period in samples (0.0 if it
        is not periodic).

    Raises:
        InputError: The file, column or a row is missing, a value is not finite, its rate is
            unknown, or it differs from the run's and ``resample`` is ``refuse``.
    """
    path = folder / w.path
    try:
        found = path.is_file()
    except OSError as error:  # a name that is too long
        raise InputError(f"{path}: can't be read: {reason(error)}") from None
    if not found:
        raise InputError(no_such_file(path))
    raw, own_rate_hz = _read(w, path)
    rate_hz = _file_rate(w, path, own_rate_hz)
    values = w.offset + w.scale * _resampled(w, path, raw, rate_hz, sample_rate_hz)
    period = 0.0 if w.period_s is None else w.period_s * sample_rate_hz
    if w.period_s is not None and period < SHORTEST_PERIOD:
        least_s = SHORTEST_PERIOD / sample_rate_hz
        raise InputError(f"{path}: period_s must be {least_s:g} or more, a sample: {w.period_s!r}")
    return values, period


def _file_rate(w: FileWaveform, path: Path, own_rate_hz: float | None) -> float:
    if own_rate_hz is None and w.file_rate_hz is None:
        raise InputError(f"{path}: has no time column t_s: set file_rate_hz")
    if own_rate_hz is not None and w.file_rate_hz is not None:
        difference = abs(own_rate_hz / w.file_rate_hz - 1.0)
        if difference > _RATE_TOLERANCE:
            raise InputError(
                f"{path}: file_rate_hz is {w.file_rate_hz:.10g} Hz, but its time column gives "
                f"{own_rate_hz:.10g} Hz"
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
    if suffix not in {".npy", ".mcap"}:
        return _read_text(w, path)
    columns, own_rate_hz = _read_mcap(path) if suffix == ".mcap" else (_read_npy(path), None)
    names = list(columns)
    values = columns[names[column_index(path, w.column, names)]]
    check_rows(path, values.size, w.first_row, w.last_row)
    return _finite(path, values[w.first_row - 1 : w.last_row], w.first_row), own_rate_hz


def _read_text(w: FileWaveform, path: Path) -> tuple[F64, float | None]:
    table = TextTable(path)
    columns = [table.index(w.column)]
    has_time = "t_s" in table.names
    columns += [table.index("t_s")] if has_time else []
    rows = table.read(columns, w.first_row, w.last_row)
    _check_count(path, rows.lines.size)
    return rows.values[0], rows.sample_rate_hz(1, _TIME_TOLERANCE) if has_time else None


def _read_npy(path: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        # Mapped, not read, so that the size in the header must fit the file. NumPy parses the
        # header as Python and passes on the errors of the parser.
        with np.errstate(over="ignore"):
            table = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, OverflowError, TypeError, TokenError):
        raise InputError(f"{path}: is not a complete NumPy file (.npy) of numbers") from None
    if not (isinstance(table, np.ndarray) and table.dtype.kind in "fiu" and table.ndim in (1, 2)):
        raise InputError(f"{path}: must hold a one- or two-dimensional array of numbers")
    if table.size == 0:
        raise InputError(f"{path}: holds no data")
    columns = table.reshape(table.shape[0], -1).T
    if len(columns) > MAX_COLUMNS:
        raise InputError(f"{path}: holds {len(columns)} columns, at most {MAX_COLUMNS} are read")
    return {str(number): column for number, column in enumerate(columns, start=1)}


def _read_mcap(path: Path) -> tuple[dict[str, npt.NDArray[Any]], float]:
    from hilctl.recording.reader import read

    recording = read(path)
    samples = recording.samples
    if np.any(np.diff(samples.index) != 1):
        raise InputError(f"{path}: samples are missing")
    names = ("reference_um", "displacement_um", "command", "wanted")
    return {name: getattr(samples, name) for name in names}, recording.sample_rate_hz


def _finite(path: Path, chosen: npt.NDArray[Any], first_row: int) -> F64:
    """Return the selected rows: float64[n], all finite."""
    _check_count(path, chosen.size)
    raw = np.array(chosen, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(raw))
    if bad.size:
        row = first_row + int(bad[0])
        raise InputError(f"{path}: row {row}: value must be finite, got {raw[bad[0]]}")
    return raw


def _check_count(path: Path, count: int) -> None:
    if count < 2:
        raise InputError(f"{path}: needs at least two rows from first_row to last_row")
    try:
        check_length(count)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
