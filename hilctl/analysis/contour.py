"""Contour error of a run of several axes: distance of the measured from the reference path.

The error of a sample is the distance of its measured point from the nearest point of the reference
path, which joins the references by straight lines. A lag along the path is no contour error; it is
the along-path error, from the sample's reference to the nearest point.

The search covers the path before and after the sample's reference, each up to twice the distance of
the measured point from that reference. The nearest point is at most 1.1 times that distance away
along the path for a lag of 90 degrees on a circle, and 1.4 times around a right angle. Other
branches that pass nearby are farther away along the path: crossing branches of a Lissajous figure
and adjacent turns of a spiral are at least a period of the fastest axis apart, and the flyback of a
raster is as far away as the end of the line.
"""

import json
import logging
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.analysis.report import build_report
from hilctl.analysis.run_metrics import RunReport
from hilctl.analysis.steady_state import steady_part
from hilctl.base.errors import DataError
from hilctl.base.formatting import finite, printable, quantity, shown_briefly
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment, common_period
from hilctl.base.types import F64, I64
from hilctl.kernels.path import nearest_on_path
from hilctl.recording.metadata_keys import AXES_FACT, AXIS_FACT
from hilctl.recording.recording import Recording
from hilctl.recording.run_summary import read_ends, recordings_in

MOST_REACH = 2**17
"""Longest lag or lead that is searched, in samples."""

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
        limited_samples: Samples with lag or lead at the search limit :data:`MOST_REACH`.
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
    """

    labels: tuple[str, ...]
    start_s: float


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
        *([("largest lag searched", limited)] if report.limited_samples else []),
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
    headings = ["segment", "start s", "peak µm", "rms µm", "mean µm", "lag ms"]
    return headings, [
        [
            "; ".join(map(printable, each.labels)),
            f"{each.start_s:g}",
            *map(quantity, (each.peak_um, each.rms_um, each.mean_um)),
            quantity(None if each.lag_s is None else 1e3 * each.lag_s),
        ]
        for each in report.segments
    ]


@dataclass(frozen=True, slots=True)
class ContourTrace:
    """Samples with their nearest points of the reference path.

    Attributes:
        index: int64[n].
        reference_um: float64[n, axes]; likewise the measured and the nearest points.
        error_um: float64[n], contour error; likewise the others.
        along_um: Along-path error.
        away: Lag or lead, in samples.
        step_um: Length of the path from the reference before.
    """

    index: I64
    reference_um: F64
    measured_um: F64
    nearest_um: F64
    error_um: F64
    along_um: F64
    away: F64
    step_um: F64

    def part(self, start: int, stop: int) -> "ContourTrace":
        """Return the samples from an index up to another."""
        low, high = np.searchsorted(self.index, (start, stop)).tolist()
        return ContourTrace(*(getattr(self, each.name)[low:high] for each in fields(self)))


def recordings_by_axis(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the recordings of one run of several axes, the fast axis first; empty otherwise.

    For a single recording, the others are found in its folder by their metadata. A missing one is
    logged as a warning.
    """
    facts = {path: _facts(path) for path in paths}
    first = facts[paths[0]]
    names = axis_names(first)
    if len(paths) == 1 and names:
        facts |= {path: _facts(path) for path in recordings_in(paths[0].parent)}
    elif not all(each.get("run_id") == first.get("run_id") for each in facts.values()):
        return {}
    run_id = first.get("run_id")
    found = {each[AXIS_FACT]: path for path, each in facts.items()
             if each.get("run_id") == run_id and each.get(AXIS_FACT) in names}  # fmt: skip
    if missing := [name for name in names if name not in found]:
        _log.warning("%s: contains no recording of axis %s", paths[0].parent, ", ".join(missing))
    return {name: found[name] for name in names if name in found} if len(found) > 1 else {}


def _facts(path: Path) -> Mapping[str, str]:
    try:
        return read_ends(path).run
    except DataError:  # no recording, which its reader explains
        return {}


def axis_names(run: Mapping[str, str]) -> list[str]:
    """Return the names of all axes from the metadata of a run; empty if it has one axis."""
    try:
        names = json.loads(run.get(AXES_FACT, "[]"))
    except ValueError:
        return []
    return [str(name) for name in names] if isinstance(names, list) else []


def contour(
    runs: Mapping[str, Iterable[Recording]],
) -> tuple[ContourReport, tuple[ContourTrace | None, ...]]:
    """Return the contour errors of a run, and the last samples of each segment, None without any.

    If the waveforms of all axes have a common period, the last samples are one such period.

    ``runs`` are the recordings of its axes by name, as repeatable iterables of pieces, which are
    read two or three times, in bounded memory. Raise DataError as
    :func:`hilctl.analysis.report.summarize` does, or if their rates differ.
    """
    builders = {name: build_report(pieces) for name, pieces in runs.items()}
    reports = {name: each.report() for name, each in builders.items()}
    rates_hz = {each.sample_rate_hz for each in reports.values()}
    if len(rates_hz) > 1:
        given = ", ".join(f"{name}: {each.sample_rate_hz:g} Hz" for name, each in reports.items())
        raise DataError(f"the axes of a run must have one sample rate: {given}")
    rate_hz = rates_hz.pop()
    shared = reduce(
        _overlaps,
        (
            [
                _Shared((segment.label,), start, stop, (segment.period,))
                for segment, (start, stop, _) in each.windows
            ]
            for each in builders.values()
        ),
    )
    total, skew = _Errors(rate_hz), _Skew([*runs][1:])
    parts = [_Part(each, rate_hz, total, _TRACED // len(shared)) for each in shared]
    for found in _evaluated(_common([*runs.values()], skew)):
        for part in parts:
            part.add(found)
    segments = tuple(part.segment() for part in parts)
    report = ContourReport(
        **total.metrics(), axes=reports, skew_us=skew.metrics_us(), segments=segments
    )
    return report, tuple(part.trace() for part in parts)


def average_contour(recordings: Sequence[Recording], segment: Segment) -> float | None:
    """Return the peak contour error of the average cycle, in percent of the path's size.

    The size is the largest peak-to-peak reference of an axis. ``segment`` has the period and the
    steady samples that all axes have in common. None without an average cycle of each axis.
    """
    cycles = [steady_part(each, segment).cycle for each in recordings]
    signals = [each.signals for each in cycles if each is not None]
    if len(signals) < len(cycles) or len({each.shape for each in signals}) > 1:
        return None
    # Three cycles, because the nearest point may be in the previous or the next one.
    path_um, points_um = (
        np.tile(np.column_stack(each), (3, 1)) for each in zip(*signals, strict=True)
    )
    index = np.arange(path_um.shape[0])
    found = _nearest((index, path_um, points_um), index.size // 3, 2 * index.size // 3)
    return float(100.0 * found.error_um.max() / np.ptp(path_um, axis=0).max())


@dataclass(frozen=True, slots=True)
class _Shared:
    """Evaluated samples of one segment of each axis, and the periods of its waveforms."""

    labels: tuple[str, ...]
    start: int
    stop: int
    periods: tuple[float, ...]

    def overlap(self, other: "_Shared") -> "_Shared":
        return _Shared(
            self.labels + other.labels,
            max(self.start, other.start),
            min(self.stop, other.stop),
            self.periods + other.periods,
        )

    def traced(self) -> int:
        """Return the samples of whole cycles of all axes; all samples without these."""
        whole = self.stop - self.start
        period = common_period(self.periods, min(whole, _MOST_CYCLES * max(self.periods)))
        return whole if period is None else min(math.ceil(period) + 1, whole)


def _overlaps(some: list[_Shared], others: list[_Shared]) -> list[_Shared]:
    found = (one.overlap(other) for one in some for other in others)
    return [each for each in found if each.start < each.stop]


def _evaluated(common: Iterable[Sequence[npt.NDArray[Any]]]) -> Iterator[ContourTrace]:
    """Yield the samples that all axes have, with their nearest points of the path between them.

    The pieces have the index int64[n], reference and displacement float64[n, axes].
    """
    held: list[npt.NDArray[Any]] = []
    first = 0
    for piece in common:
        held = (
            [np.concatenate(each) for each in zip(held, piece, strict=True)] if held else [*piece]
        )
        end = held[0].size - MOST_REACH
        if end - first >= _TOGETHER:
            yield _nearest(held, first, end)
            held = [each[max(0, end - MOST_REACH) :] for each in held]
            first = min(end, MOST_REACH)
    if held and held[0].size > 1:
        yield _nearest(held, first, held[0].size)


def _nearest(rows: Sequence[npt.NDArray[Any]], first: int, end: int) -> ContourTrace:
    """Return the rows from ``first`` to ``end`` that all axes have measured."""
    index, path_um, points_um = rows
    at = np.arange(first, end)
    at = at[np.isfinite(points_um[at]).all(axis=1)]
    steps_um = np.append(0.0, np.linalg.norm(np.diff(path_um, axis=0), axis=1))
    arc_um, measured_um, whole = np.cumsum(steps_um), points_um[at], np.arange(index.size)
    error_um, place = np.empty(at.size), np.empty(at.size)
    nearest_on_path(path_um, arc_um, measured_um, at, MOST_REACH, error_um, place)
    return ContourTrace(
        index[at],
        path_um[at],
        measured_um,
        np.column_stack([np.interp(place, whole, each) for each in path_um.T]),
        error_um,
        np.interp(place, whole, arc_um) - arc_um[at],
        np.abs(place - at),
        steps_um[at],
    )


class _Errors:
    """Sums of contour and along-path errors."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._samples = self._limited = 0
        self._sums = np.zeros(5)  # of error, its square, along, its square, and step of the path
        self._peaks = np.zeros(2)  # of both errors

    def add(self, found: ContourTrace) -> None:
        """Add at least one sample."""
        self._samples += found.index.size
        self._limited += int(np.count_nonzero(found.away >= MOST_REACH))
        for k, values in enumerate((found.error_um, found.along_um)):
            self._sums[2 * k : 2 * k + 2] += values.sum(), values @ values
            self._peaks[k] = max(self._peaks[k], np.abs(values).max())
        self._sums[4] += found.step_um.sum()

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
    """Contour errors of a segment; they are also added to those of the run."""

    def __init__(self, segment: _Shared, rate_hz: float, total: _Errors, most_traced: int) -> None:
        self._segment, self._rate_hz, self._total = segment, rate_hz, total
        self._traced = min(segment.traced(), max(most_traced, 2))
        self._traces: deque[ContourTrace] = deque()
        self._errors = _Errors(rate_hz)

    def add(self, found: ContourTrace) -> None:
        """Take the next samples; those outside the segment are ignored."""
        mine = found.part(self._segment.start, self._segment.stop)
        if not mine.index.size:
            return
        for errors in (self._errors, self._total):
            errors.add(mine)
        self._traces.append(mine.part(int(mine.index[-self._traced :][0]), self._segment.stop))
        traced = sum(each.index.size for each in self._traces)
        while traced - self._traces[0].index.size >= self._traced:
            traced -= self._traces.popleft().index.size

    def segment(self) -> ContourSegment:
        return ContourSegment(
            **self._errors.metrics(),
            labels=self._segment.labels,
            start_s=self._segment.start / self._rate_hz,
        )

    def trace(self) -> ContourTrace | None:
        """Return the last samples; None without any."""
        if not self._traces:
            return None
        names = [each.name for each in fields(ContourTrace)]
        columns = ([getattr(each, name) for each in self._traces] for name in names)
        return ContourTrace(*(np.concatenate(each)[-self._traced :] for each in columns))


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

    def metrics_us(self) -> dict[str, dict[str, float]]:
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


def _common(runs: Sequence[Iterable[Recording]], skew: _Skew) -> Iterator[list[npt.NDArray[Any]]]:
    """Read all axes at the same pace, and yield the samples that they have in common."""
    heads = [iter(pieces) for pieces in runs]
    samples, ticks = _Join(len(runs)), _Join(len(runs))
    reached = [-1] * len(runs)
    while True:
        axis = reached.index(min(reached))
        if (piece := next(heads[axis], None)) is None:
            return  # nothing more is in common
        if piece.samples.index.size:
            reached[axis] = int(piece.samples.index[-1])
        if found := ticks.add(axis, piece.ticks.first_sample, piece.ticks.late_ns):
            skew.add(found[1])
        if rows := samples.add(axis, *_columns(piece.samples)):
            yield rows


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
