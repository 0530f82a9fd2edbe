"""Waveforms from tables and recordings, resampled on request."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import InputError
from hilctl.base.files import no_such_file, reason
from hilctl.base.segments import SHORTEST_PERIOD
from hilctl.base.table import ArrayTable, Table
from hilctl.base.table_file import open_table
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
        raise InputError(
            f"{path}: has no time column (t_s, or the only one in s): set file_rate_hz"
        )
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
    if path.suffix.lower() == ".mcap":
        columns, own_rate_hz = _read_mcap(path)
        table: Table = ArrayTable(path, columns)
    else:
        table, own_rate_hz = open_table(path), None
    at, time = table.index(w.column), table.time()
    base, factor = table.unit(at)
    rows = table.read([at] if time is None else [at, time], w.first_row, w.last_row)
    count = rows.lines.size
    if count < 2:
        raise InputError(f"{path}: needs at least two rows from first_row to last_row")
    try:
        check_length(count)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if time is not None:
        own_rate_hz = rows.sample_rate_hz(1, _TIME_TOLERANCE, table.unit(time)[1])
    if path.suffix.lower() == ".mcap":  # its references may be in A or V
        factor = 1.0
    elif w.unit is not None and base not in {"", w.unit} and w.scale == 1.0:
        raise InputError(
            f"{path}: column {table.names[at]} is in {base}, the waveform in {w.unit}: set scale, "
            f"in {w.unit} per {base}"
        )
    return rows.values[0] * factor, own_rate_hz


def _read_mcap(path: Path) -> tuple[dict[str, npt.NDArray[Any]], float]:
    from hilctl.recording.reader import read

    recording = read(path)
    samples = recording.samples
    if np.any(np.diff(samples.index) != 1):
        raise InputError(f"{path}: samples are missing")
    names = ("reference_um", "displacement_um", "command", "wanted")
    return {name: getattr(samples, name) for name in names}, recording.sample_rate_hz
