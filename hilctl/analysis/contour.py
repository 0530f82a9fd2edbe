"""Contour error of a run of several axes: distance of the measured from the reference path.

The error of a sample is the distance of its measured point from the nearest point of the reference
path, which joins the references by straight lines. A lag along the path is no contour error; it is
the along-path error, from the sample's reference to the nearest point.

The nearest point is searched around the sample's reference, in a window of time, so that another
branch of the path is not taken: a quarter of the period of the fastest axis before and after. Two
branches of a Lissajous figure cross at least a whole one of these periods apart, two turns of a
spiral lie one apart. An axis whose reference is no sine has the period of the sine with its rms
deviation and rms speed. A lag of more than the window is reported as limited samples.
"""

import json
import logging
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.analysis.report import Windows, build_report
from hilctl.analysis.run_metrics import RunReport
from hilctl.base.errors import DataError
from hilctl.base.formatting import finite, printable, quantity, shown_briefly
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.types import F64, I64
from hilctl.kernels.path import nearest_on_path
from hilctl.recording.metadata_keys import AXES_FACT, AXIS_FACT
from hilctl.recording.recording import Recording
from hilctl.recording.run_summary import read_ends, recordings_in

MOST_REACH = 2**17
"""Longest window before and after a sample, in samples."""

_TOGETHER = 2**17  # samples
_TRACED = 2**18  # samples of all segments
_MOST_CYCLES = 64
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ContourMetrics:
    """Errors of single samples, in um; None without any.

    Attributes:
        peak_um: Largest contour error.
        along_mean_um: Mean along-path error; negative if the axes lag.
        lag_s: Mean lag: the mean along-path error over the mean speed of the reference.
        limited_samples: Samples whose nearest point is at the end of the window.
    """

    samples: int
    peak_um: float | None
    rms_um: float | None
    mean_um: float | None
    along_peak_um: float | None
    along_rms_um: float | None
    along_mean_um: float | None
    lag_s: float | None
    limited_samples: int


@dataclass(frozen=True, slots=True)
class ContourSegment(ContourMetrics):
    """Errors of the samples that are evaluated on all axes, while each has one waveform.

    Attributes:
        labels: The waveform of each axis.
        start_s: Time of the first evaluated sample since the start of the run.
        window_s: Longest time between a sample's reference and its nearest point.
    """

    labels: tuple[str, ...]
    start_s: float
    window_s: float


@shown_briefly
@dataclass(frozen=True, slots=True)
class ContourReport(ContourMetrics):
    """Errors of a run over all segments, and the report of each axis.

    Attributes:
        axes: By name, the fast axis first.
        skew_us: Of each axis but the first: ``mean``, and ``max`` in magnitude, of the time from
            the exchange of the first axis to its own, in us; empty without common ticks.
    """

    axes: Mapping[str, RunReport]
    skew_us: Mapping[str, Mapping[str, float]]
    segments: tuple[ContourSegment, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        mapping: dict[str, Any] = finite(asdict(self))
        return mapping


def contour_rows(report: ContourReport) -> list[tuple[str, str]]:
    """Return name and value of the errors of a run."""
    um = partial(quantity, unit="um")
    along = f"{um(report.along_mean_um)} mean, {um(report.along_rms_um)} rms"
    limited = f"{report.limited_samples:,} of {report.samples:,}: their lag may be longer"
    known = [
        ("contour error", f"{um(report.peak_um)} peak, {um(report.rms_um)} rms, "
         f"{um(report.mean_um)} mean"),
        ("along the path", f"{along}, {um(report.along_peak_um)} peak"),
        ("lag", quantity(report.lag_s, "s")),
        *([("at the end of the window", limited)] if report.limited_samples else []),
    ]  # fmt: skip
    first, *_ = report.axes
    return [
        *(known if report.samples else []),
        *(
            (f"skew of {name}", f"{quantity(each['mean'], 'us')} mean, "
             f"{quantity(each['max'], 'us')} max after {first}")
            for name, each in report.skew_us.items()
            if each["max"]  # otherwise the run did not keep real time
        ),
        ("evaluated samples", f"{report.samples:,}"),
    ]  # fmt: skip


def contour_table(report: ContourReport) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of all segments."""
    headings = ["segment", "start s", "peak µm", "rms µm", "mean µm", "lag ms", "window ms"]
    return headings, [
        [
            "; ".join(map(printable, each.labels)),
            f"{each.start_s:g}",
            *map(quantity, (each.peak_um, each.rms_um, each.mean_um)),
            quantity(None if each.lag_s is None else 1e3 * each.lag_s),
            quantity(1e3 * each.window_s),
        ]
        for each in report.segments
    ]


@dataclass(frozen=True, slots=True)
class ContourTrace:
    """Last evaluated samples of a segment, whole cycles of all axes if it repeats.

    Attributes:
        t_s: float64[n], time since the start of the run.
        reference_um: float64[n, axes]; likewise the others.
        nearest_um: Nearest points of the reference path.
        along_um: float64[n], along-path error.
    """

    t_s: F64
    reference_um: F64
    measured_um: F64
    nearest_um: F64
    along_um: F64

    @property
    def error_um(self) -> F64:
        """Contour error: float64[n]."""
        error_um: F64 = np.linalg.norm(self.measured_um - self.nearest_um, axis=1)
        return error_um


def recordings_by_axis(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the recordings of one run of several axes, the fast axis first; empty otherwise.

    The others of a single recording are found by their facts in its folder. A missing one is logged
    as a warning.
    """
    facts = {path: _facts(path) for path in paths}
    first = facts[paths[0]]
    names = _names(first)
    if len(paths) == 1 and names:
        facts |= {path: _facts(path) for path in recordings_in(paths[0].parent)}
    elif not all(each.get("run_id") == first.get("run_id") for each in facts.values()):
        return {}
    run_id = first.get("run_id")
    found = {each[AXIS_FACT]: path for path, each in facts.items()
             if each.get("run_id") == run_id and each.get(AXIS_FACT) in names}  # fmt: skip
    if missing := [name for name in names if name not in found]:
        _log.warning("%s: no recording of axis %s there", paths[0].parent, ", ".join(missing))
    return {name: found[name] for name in names if name in found} if len(found) > 1 else {}


def _facts(path: Path) -> Mapping[str, str]:
    try:
        return read_ends(path).run
    except DataError:  # no recording, which its reader explains
        return {}


def _names(run: Mapping[str, str]) -> list[str]:
    try:
        names = json.loads(run.get(AXES_FACT, "[]"))
    except ValueError:
        return []
    return [str(name) for name in names] if isinstance(names, list) else []


def contour(
    runs: Mapping[str, Iterable[Recording]],
) -> tuple[ContourReport, tuple[ContourTrace | None, ...]]:
    """Return the contour errors of a run, and a trace of each segment, None without samples.

    ``runs`` are the recordings of its axes by name, as repeatable iterables of pieces, which are
    read two or three times, in bounded memory. Raise DataError as
    :func:`hilctl.analysis.report.summarize` does, or if their rates differ.
    """
    surveys = [_Survey(pieces) for pieces in runs.values()]
    reports = {name: each.report for name, each in zip(runs, surveys, strict=True)}
    rates_hz = {each.sample_rate_hz for each in reports.values()}
    if len(rates_hz) > 1:
        given = ", ".join(f"{name}: {each.sample_rate_hz:g} Hz" for name, each in reports.items())
        raise DataError(f"the axes of a run must have one sample rate: {given}")
    rate_hz = rates_hz.pop()
    stretches = reduce(_overlaps, (each.stretches() for each in surveys))
    total, skew = _Errors(rate_hz), _Skew([*runs][1:])
    parts = [_Part(each, rate_hz, total, _TRACED // len(stretches)) for each in stretches]
    _read_together([*runs.values()], parts, skew)
    segments = tuple(part.segment() for part in parts)
    report = ContourReport(
        **total.metrics(), axes=reports, skew_us=skew.figures_us(), segments=segments
    )
    return report, tuple(part.trace() for part in parts)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Evaluated samples of one segment of each axis.

    ``quarter`` is that of the period of the fastest axis, in samples; ``periods`` are those of the
    waveforms.
    """

    labels: tuple[str, ...]
    start: int
    stop: int
    quarter: float
    periods: tuple[float, ...]

    def overlap(self, other: "_Stretch") -> "_Stretch":
        return _Stretch(
            self.labels + other.labels,
            max(self.start, other.start),
            min(self.stop, other.stop),
            min(self.quarter, other.quarter),
            self.periods + other.periods,
        )

    def traced(self) -> int:
        """Return the samples of whole cycles of all axes; all samples without these."""
        longest, whole = max(self.periods), self.stop - self.start
        for cycles in range(1, _MOST_CYCLES + 1):
            turns = [cycles * longest / each for each in self.periods if each > 0.0]
            if len(turns) == len(self.periods) and all(
                abs(each - round(each)) < 1e-6 for each in turns
            ):
                return min(math.ceil(cycles * longest) + 1, whole)
        return whole


def _overlaps(some: list[_Stretch], others: list[_Stretch]) -> list[_Stretch]:
    found = (one.overlap(other) for one in some for other in others)
    return [each for each in found if each.start < each.stop]


class _Survey:
    """The report of one axis, its evaluated samples, and the pace of its reference in them."""

    def __init__(self, pieces: Iterable[Recording]) -> None:
        self._windows: Windows = []
        self._paces: list[_Pace] = []
        self.report = build_report(pieces, self._observe).report()

    def _observe(self, windows: Windows) -> Callable[[Recording], None]:
        self._windows, self._paces = windows, [_Pace() for _ in windows]
        return self._add

    def _add(self, piece: Recording) -> None:
        for (_, (start, stop, _)), pace in zip(self._windows, self._paces, strict=True):
            if piece.samples.index.size and start <= piece.samples.index[-1]:
                pace.add(piece.samples.part(start, stop).reference_um)

    def stretches(self) -> list[_Stretch]:
        return [
            _Stretch((segment.label,), start, stop, pace.quarter(), (segment.period,))
            for (segment, (start, stop, _)), pace in zip(self._windows, self._paces, strict=True)
        ]


class _Pace:
    """Rms deviation of a reference, and its rms step."""

    def __init__(self) -> None:
        self._first: float | None = None
        self._sums = np.zeros(5)  # of 1, value, its square; 1, and square of a step

    def add(self, reference_um: F64) -> None:
        known = reference_um[np.isfinite(reference_um)]
        if known.size:
            self._first = float(known[0]) if self._first is None else self._first
            since, steps = known - self._first, np.diff(known)
            sums = since.size, since.sum(), float(since @ since), steps.size, float(steps @ steps)
            self._sums += np.array(sums)

    def quarter(self) -> float:
        """Return a quarter of the period of such a sine, in samples; infinite at rest."""
        values, total, squares, steps, step_squares = self._sums.tolist()
        if not step_squares:
            return math.inf
        variance = max(squares / values - (total / values) ** 2, 0.0)
        return 0.5 * math.pi * math.sqrt(variance * steps / step_squares)


class _Errors:
    """Sums of contour and along-path errors."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._samples = self._limited = 0
        self._sums = np.zeros(5)  # of error, its square, along, its square, and step of the path
        self._peaks = np.zeros(2)  # of both errors

    def add(self, error_um: F64, along_um: F64, step_um: F64, limited: int) -> None:
        """Add samples; the errors, and the step of the reference to each: float64[n]."""
        if not error_um.size:
            return
        self._samples += error_um.size
        self._limited += limited
        for k, values in enumerate((error_um, along_um)):
            self._sums[2 * k : 2 * k + 2] += values.sum(), values @ values
            self._peaks[k] = max(self._peaks[k], np.abs(values).max())
        self._sums[4] += step_um.sum()

    def metrics(self) -> dict[str, Any]:
        """Return the fields of :class:`ContourMetrics`."""
        names = [each.name for each in fields(ContourMetrics)]
        if not self._samples:
            return dict.fromkeys(names) | {"samples": 0, "limited_samples": 0}
        mean, square, along, along_square, step = (self._sums / self._samples).tolist()
        peak, along_peak = self._peaks.tolist()
        lag_s = -along / (step * self._rate_hz) if step else None
        found = (peak, math.sqrt(square), mean, along_peak, math.sqrt(along_square), along, lag_s)
        return dict(zip(names, (self._samples, *found, self._limited), strict=True))


class _Part:
    """Contour errors of a stretch, in pieces; they are also added to those of the run."""

    def __init__(self, stretch: _Stretch, rate_hz: float, total: _Errors, most_traced: int) -> None:
        self._stretch, self._rate_hz, self._total = stretch, rate_hz, total
        self._reach = int(min(max(stretch.quarter, 1.0), MOST_REACH))
        self._beside = self._reach + 1  # a row more than a window tells that the path goes on
        self._next = stretch.start
        self._held: list[npt.NDArray[Any]] = []
        self._traced = min(stretch.traced(), max(most_traced, 2))
        self._traces: deque[list[F64]] = deque()
        self._errors = _Errors(rate_hz)

    def add(self, rows: Sequence[npt.NDArray[Any]]) -> None:
        """Take the next samples, also those around the stretch that its windows reach.

        They are the index int64[n], reference and displacement float64[n, axes].
        """
        around = self._stretch.start - self._beside, self._stretch.stop + self._beside
        low, high = np.searchsorted(rows[0], around).tolist()
        if low == high:
            return
        held = [[], [], []] if not self._held else [[each] for each in self._held]
        self._held = [
            np.concatenate([*before, each[low:high]])
            for before, each in zip(held, rows, strict=True)
        ]
        if self._held[0].size > 2 * self._beside + _TOGETHER:
            self._evaluate(self._held[0].size - self._beside)

    def finish(self) -> None:
        """Evaluate what is left, after the last samples."""
        if self._held and self._held[0].size > 1:
            self._evaluate(self._held[0].size)

    def _evaluate(self, end: int) -> None:
        """Evaluate rows before ``end``, and keep those that later windows reach."""
        index, path_um, points_um = self._held
        first, last = np.searchsorted(index, (self._next, self._stretch.stop)).tolist()
        self._next = int(index[end - 1]) + 1
        at = np.arange(first, max(min(last, end), first))
        at = at[np.isfinite(points_um[at]).all(axis=1)]
        rows, points_um = np.arange(index.size), points_um[at]
        steps_um = np.append(0.0, np.linalg.norm(np.diff(path_um, axis=0), axis=1))
        arc_um = np.cumsum(steps_um)
        error_um, place = np.empty(at.size), np.empty(at.size)
        limited = nearest_on_path(path_um, arc_um, points_um, at, self._reach, error_um, place)
        along_um = np.interp(place, rows, arc_um) - arc_um[at]
        for errors in (self._errors, self._total):
            errors.add(error_um, along_um, steps_um[at], limited)
        nearest_um = np.column_stack([np.interp(place, rows, each) for each in path_um.T])
        columns = (index[at] / self._rate_hz, path_um[at], points_um, nearest_um, along_um)
        self._traces.append([each[-self._traced :] for each in columns])
        traced = sum(each[0].size for each in self._traces)
        while traced - self._traces[0][0].size >= self._traced:
            traced -= self._traces.popleft()[0].size
        self._held = [each[max(0, end - self._beside) :] for each in self._held]

    def segment(self) -> ContourSegment:
        return ContourSegment(
            **self._errors.metrics(),
            labels=self._stretch.labels,
            start_s=self._stretch.start / self._rate_hz,
            window_s=self._reach / self._rate_hz,
        )

    def trace(self) -> ContourTrace | None:
        """Return the last samples; None without any."""
        columns = [
            np.concatenate(each)[-self._traced :] for each in zip(*self._traces, strict=True)
        ]
        return ContourTrace(*columns) if columns and columns[0].size else None


class _Skew:
    """Differences of the times of exchange of the other axes from the first."""

    def __init__(self, others: Sequence[str]) -> None:
        self._others = others
        self._ticks, self._largest_ns = 0, np.zeros(len(others))
        self._sum_ns = np.zeros(len(others))

    def add(self, late_ns: I64) -> None:
        """Add ticks: int64[n, axes]."""
        if late_ns.size:
            after_ns = late_ns[:, 1:] - late_ns[:, :1]
            self._ticks += after_ns.shape[0]
            self._sum_ns += after_ns.sum(axis=0)
            self._largest_ns = np.maximum(self._largest_ns, np.abs(after_ns).max(axis=0))

    def figures_us(self) -> dict[str, dict[str, float]]:
        if not self._ticks:
            return {}
        figures = zip(self._others, self._sum_ns / self._ticks, self._largest_ns, strict=True)
        return {
            name: {"mean": float(mean) * 1e-3, "max": float(largest) * 1e-3}
            for name, mean, largest in figures
        }


class _Join:
    """Rows of several axes, matched by their index."""

    def __init__(self, axes: int) -> None:
        self._held: list[tuple[npt.NDArray[Any], ...] | None] = [None] * axes

    def add(self, axis: int, *columns: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Take the next rows of an axis, the increasing index first.

        Return the index of the next rows that all axes have, and each other column of these,
        [n, axes]; nothing if there are none.
        """
        before = self._held[axis]
        self._held[axis] = (
            columns
            if before is None
            else tuple(map(np.concatenate, zip(before, columns, strict=True)))
        )
        held = [each for each in self._held if each is not None and each[0].size]
        if len(held) < len(self._held):
            return []
        stop = min(each[0][-1] for each in held) + 1
        cuts = [int(np.searchsorted(each[0], stop)) for each in held]
        common = reduce(
            partial(np.intersect1d, assume_unique=True),
            (each[0][:cut] for each, cut in zip(held, cuts, strict=True)),
        )
        rows = [np.searchsorted(each[0], common) for each in held]
        found = [
            np.column_stack([each[k][row] for each, row in zip(held, rows, strict=True)])
            for k in range(1, len(columns))
        ]
        self._held = [
            tuple(column[cut:] for column in each) for each, cut in zip(held, cuts, strict=True)
        ]
        return [common, *found]


def _read_together(
    runs: Sequence[Iterable[Recording]], parts: Sequence[_Part], skew: _Skew
) -> None:
    """Read all axes at the same pace, and evaluate what they have in common."""
    heads = [iter(pieces) for pieces in runs]
    samples, ticks = _Join(len(runs)), _Join(len(runs))
    reached = [-1] * len(runs)
    while True:
        axis = reached.index(min(reached))
        if (piece := next(heads[axis], None)) is None:
            break  # nothing more is in common
        if piece.samples.index.size:
            reached[axis] = int(piece.samples.index[-1])
        if rows := samples.add(axis, *_columns(piece.samples)):
            for part in parts:
                part.add(rows)
        if found := ticks.add(axis, piece.ticks.first_sample, piece.ticks.late_ns):
            skew.add(found[1])
    for part in parts:
        part.finish()


def _columns(samples: Samples) -> tuple[I64, F64, F64]:
    """Return index, reference and displacement of the waveform; a rejected reading is NaN."""
    known = (samples.flags & np.uint32(NO_WAVEFORM)) == 0
    samples = samples.rows(known & np.isfinite(samples.reference_um))
    rejected = (samples.flags & np.uint32(Flag.SENSOR_INVALID)) != 0
    return (
        samples.index,
        samples.reference_um,
        np.where(rejected, np.nan, samples.displacement_um),
    )
