"""Builder of complete references: shapes, soft starts and ends, sequences, segments."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import InputError
from hilctl.base.files import no_such_file, reason
from hilctl.base.segments import SHORTEST_PERIOD, Segment
from hilctl.base.table import ArrayTable, RowError, Table, open_table
from hilctl.base.types import CHUNK, F64, chunks
from hilctl.kernels.spline import cubic_spline
from hilctl.waveforms import shapes, spec

_RATE_TOLERANCE = 1e-6
_TIME_TOLERANCE = 0.01  # largest deviation of a step from the median


def read_samples(w: spec.FileWaveform, sample_rate_hz: float, folder: Path) -> tuple[F64, float]:
    """Read a waveform at the run's sample rate; return it, and its period in samples or 0.0.

    Raise InputError if the file, column or a row is missing, a value is not finite, its rate is
    unknown, or it differs from the run's and ``resample`` is ``refuse``.
    """
    path = folder / w.path
    try:
        found = path.is_file()
    except OSError as error:  # a name that is too long
        raise InputError(f"{path}: cannot be read: {reason(error)}") from None
    if not found:
        raise InputError(no_such_file(path))
    raw, own_rate_hz = _read(w, path)
    rate_hz = _file_rate(w, path, own_rate_hz)
    values = w.offset + w.scale * _resampled(w, path, raw, rate_hz, sample_rate_hz)
    period = 0.0 if w.period_s is None else w.period_s * sample_rate_hz
    if w.period_s is not None and period < SHORTEST_PERIOD:
        least_s = SHORTEST_PERIOD / sample_rate_hz
        raise InputError(f"{path}: period_s must be >= {least_s:g}, one sample: {w.period_s!r}")
    return values, period


def _file_rate(w: spec.FileWaveform, path: Path, own_rate_hz: float | None) -> float:
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


def _resampled(
    w: spec.FileWaveform, path: Path, raw: F64, rate_hz: float, sample_rate_hz: float
) -> F64:
    if abs(rate_hz / sample_rate_hz - 1.0) <= _RATE_TOLERANCE:
        return raw
    if w.resample == "refuse":
        raise InputError(
            f"{path}: sampled at {rate_hz:.10g} Hz, the run at {sample_rate_hz:.10g} Hz: "
            "set resample to linear or cubic, or sample_rate_hz to the file's"
        )
    t_file = np.arange(raw.size) / rate_hz
    shapes.check_length(float(t_file[-1]) * sample_rate_hz)
    n = int(t_file[-1] * sample_rate_hz + 1e-9) + 1
    t = np.arange(n) / sample_rate_hz
    if w.resample == "linear":
        return np.interp(t, t_file, raw)
    found = np.empty(n)
    cubic_spline(raw, t * rate_hz, np.empty(raw.size), np.empty(raw.size), found)
    return found


def _read(w: spec.FileWaveform, path: Path) -> tuple[F64, float | None]:
    if path.suffix.lower() == ".mcap":
        columns, own_rate_hz = _read_mcap(path)
        table: Table = ArrayTable(path, columns)
    else:
        table, own_rate_hz = open_table(path), None
    at, time = table.index(w.column), table.only({"t_s"}, "s")
    base, factor = table.unit(at)
    try:
        rows = table.read([at] if time is None else [at, time], w.first_row, w.last_row)
    except RowError as error:
        raise error.without("") from None
    count = rows.lines.size
    if count < 2:
        raise InputError(f"{path}: needs at least two rows from first_row to last_row")
    try:
        shapes.check_length(count)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if time is not None:
        own_rate_hz, _ = rows.sample_grid(1, _TIME_TOLERANCE, table.unit(time)[1])
    if path.suffix.lower() == ".mcap":  # references of a recording may be in A or V
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


@dataclass(frozen=True, slots=True)
class RepeatedPart:
    """A periodic part of a reference; the period in samples need not be whole."""

    start: int
    stop: int
    period: float


@dataclass(frozen=True, slots=True)
class Reference:
    """The samples of a run's waveform.

    Attributes:
        values: float64[n], read-only, in ``unit``.
        segments: Segments of the waveforms, with their steady samples.
        span: Lowest and highest value.
        repeats: Periodic parts of a long reference.
    """

    values: F64
    unit: spec.WaveformUnit
    sample_rate_hz: float
    segments: tuple[Segment, ...]
    span: tuple[float, float]
    repeats: tuple[RepeatedPart, ...] = ()

    @property
    def telling(self) -> tuple[slice, ...]:
        """Representative parts: all of it except most periods of long periodic parts."""
        return telling(self.values.size, self.repeats)

    @property
    def speed(self) -> float:
        """Fastest change, in ``unit`` per s."""
        steps = (np.abs(np.diff(self.values[each])) for each in self.telling)
        return self.sample_rate_hz * max(float(each.max(initial=0.0)) for each in steps)

    def held(self, samples: int) -> "Reference":
        """Return the reference with its last value repeated up to a number of samples."""
        if (more := samples - self.values.size) <= 0:
            return self
        values = np.pad(self.values, (0, more), mode="edge")
        values.flags.writeable = False
        return replace(self, values=values)


@dataclass(frozen=True, slots=True)
class _Part:
    """One waveform of a reference, and whether its steady part is periodic."""

    values: F64
    segment: Segment
    repeats: bool


def build(
    waveform: spec.AnyWaveform, sample_rate_hz: float, folder: Path, rest: float = 0.0
) -> Reference:
    """Compute every sample of a waveform; ``rest`` is the default of its key ``rest``.

    Raise InputError if a file is not usable, the waveform is too long, a soft start does not fit, a
    frequency is not below half the sample rate, or a value is too large for a float.
    """
    if waveform.unit is None:
        raise InputError("unit is required: um, A or V")
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite values are rejected below
        parts, repeat = _parts(waveform, waveform.unit, sample_rate_hz, folder, rest)
        values = parts[0].values
        if len(parts) * repeat > 1:
            values = np.concatenate([part.values for part in parts] * repeat)
        values.flags.writeable = False
        repeats = _repeats(parts, repeat) if values.size > shapes.LONG else ()
        told = telling(values.size, repeats)
        spans = [(each.min(), each.max()) for each in chunks(values, told)]
    span = float(np.min(spans)), float(np.max(spans))  # keeps a NaN, unlike min()
    if not np.isfinite(span).all():
        raise InputError("amplitude, offset or scale is too large: a value is not finite")
    segments, start = [], 0
    for part in [*parts] * repeat:
        segments.append(part.segment.shifted(start))
        start += part.values.size
    return Reference(values, waveform.unit, sample_rate_hz, tuple(segments), span, repeats)


def _repeats(parts: list[_Part], repeat: int) -> tuple[RepeatedPart, ...]:
    """Return the periodic parts of a long reference: the whole reference, or its steady parts."""
    once = sum(part.values.size for part in parts)
    if repeat > 1:
        return (RepeatedPart(0, repeat * once, float(once)),)
    found, start = [], 0
    for part in parts:
        if part.repeats:
            segment = part.segment.shifted(start)
            found.append(RepeatedPart(segment.steady_start, segment.steady_stop, segment.period))
        start += part.values.size
    return tuple(found)


def _parts(
    waveform: spec.AnyWaveform, unit: str, sample_rate_hz: float, folder: Path, rest: float
) -> tuple[list[_Part], int]:
    """Return the parts of a waveform and the number of repeats."""
    if waveform.kind != "sequence":
        return [_part(waveform, waveform.kind, unit, sample_rate_hz, folder, rest)], 1
    built = []
    samples = 0
    for i, each in enumerate(waveform.parts):
        part = _part(each, f"parts.{i} ({each.kind})", unit, sample_rate_hz, folder, rest)
        samples += part.values.size
        shapes.check_length(samples * waveform.repeat)
        built.append(part)
    return built, waveform.repeat


def _part(
    w: spec.SinglePart, name: str, unit: str, sample_rate_hz: float, folder: Path, rest: float
) -> _Part:
    if w.rest is None:
        w = w.model_copy(update={"rest": rest})
    if w.kind == "file":
        values, period = read_samples(w, sample_rate_hz, folder)
        label = f"file {Path(w.path).name}"
    else:
        label, highest_hz, period_s = shapes.outline(w, unit)
        if highest_hz >= sample_rate_hz / 2.0:
            raise InputError(
                f"{name}: every frequency must be below half the sample rate, "
                f"{sample_rate_hz / 2.0:.10g} Hz: {highest_hz:.10g} Hz"
            )
        values, period = shapes.sampled(w, sample_rate_hz), period_s * sample_rate_hz
    n = values.size
    soft_start, soft_end = _soft_samples(w, name, n, sample_rate_hz)
    period = period if math.isfinite(period) else 0.0
    segment = Segment(label, 0, n, soft_start, n - soft_end, period)
    _soften(values, w.rest_value, soft_start, soft_end)
    # The period of a file is not verified.
    return _Part(values, segment, period > 0.0 and w.kind != "file")


def _soft_samples(w: spec.SinglePart, name: str, n: int, sample_rate_hz: float) -> tuple[int, int]:
    """Return the lengths of soft start and soft end in ``n`` samples."""
    soft_s = w.soft_start_s + w.soft_end_s
    if soft_s * sample_rate_hz > n + 0.5:
        raise InputError(
            f"{name}: soft_start_s + soft_end_s = {soft_s:.10g} s must fit in its "
            f"{n / sample_rate_hz:.10g} s"
        )
    # tolerance for rounding; never more than n together
    return int(w.soft_start_s * sample_rate_hz + 1e-6), int(w.soft_end_s * sample_rate_hz + 1e-6)


def _soften(values: F64, rest: float, start: int, end: int) -> None:
    """Fade the first ``start`` and the last ``end`` values from and to rest, in place."""
    first, last = values[:start], values[values.size - end :]
    first[:] = rest + _raised_cosine(start) * (first - rest)
    last[:] = rest + _raised_cosine(end)[::-1] * (last - rest)


def _raised_cosine(n: int) -> F64:
    """Return a raised cosine from 0 to 1: float64[n]."""
    values: F64 = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / max(n, 1))
    return values


def telling(size: int, repeats: Sequence[RepeatedPart]) -> tuple[slice, ...]:
    """Return the representative parts of a reference."""
    parts, at = [], 0
    for each in repeats:
        shown, ends_at = each.start + shapes.telling_samples(each.period), each.stop - CHUNK
        if shown < ends_at:
            parts.append(slice(at, shown))
            at = ends_at
    return (*parts, slice(at, size))
