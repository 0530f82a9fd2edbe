"""Steady cycles: found, averaged, and resampled to a number of points a loop."""

from collections.abc import Collection, Iterable

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.identify.data.period import find_period
from hilctl.identify.data.records import FEWEST_POINTS, History, SteadyLoop
from hilctl.recording.recording import Recording

_LARGEST = 1e100  # no reading is; the spline's differences and products stay finite below it


class CycleMean:
    """The mean of cycles, of samples that come in any number of pieces.

    Samples fall into bins around evenly spaced phases, no more bins than samples a period, so
    that a period of any length, whole or not, fills all of them. A bin's mean stands at its
    samples' mean phase; a periodic spline through them gives the points.

    Args:
        label: Named in errors.
        period: Samples a period.
        points: Points wanted.
        signals: Signals that a sample has.

    Raises:
        DataError: The period is too short.
    """

    def __init__(self, label: str, period: float, points: int, signals: int) -> None:
        bins = min(points, int(period + 1e-9))
        if bins < FEWEST_POINTS:
            raise DataError(
                f"{label}: needs at least {FEWEST_POINTS} samples and points a cycle, got "
                f"{period:g} samples and {points} points"
            )
        self._label, self._points, self._bins = label, points, bins
        self._count = np.zeros(bins, dtype=np.int64)
        self._offset = np.zeros(bins)
        self._sums = np.zeros((signals, bins))

    def add(self, phase: F64, values: F64) -> None:
        """Take in samples.

        Args:
            phase: float64[n], time in periods since the start of the first cycle.
            values: float64[m, n], signals.
        """
        bins = self._bins
        nearest = np.floor(phase * bins + 0.5)
        index = nearest.astype(np.int64) % bins
        self._count += np.bincount(index, minlength=bins)
        self._offset += np.bincount(index, phase * bins - nearest, bins)
        with np.errstate(invalid="ignore", over="ignore"):  # that is refused at the end
            self._sums += [np.bincount(index, row, bins) for row in values]

    def cycle(self) -> F64:
        """Return the mean cycle: float64[m, points]; the first point has phase 0.

        Raises:
            DataError: Samples are missing around a phase, or are no numbers to be averaged.
        """
        if not self._count.all():
            missing = int(np.argmin(self._count))
            raise DataError(
                f"{self._label}: no sample at {missing / self._bins:.3f} of the cycle in any "
                "cycle: samples are missing in the data"
            )
        knots = (np.arange(self._bins) + self._offset / self._count) / self._bins
        means = self._sums / self._count
        if not (np.abs(means) < _LARGEST).all():
            raise DataError(
                f"{self._label}: holds values that are not finite, or too large to be averaged"
            )
        closed = np.append(knots, knots[0] + 1.0), np.hstack([means, means[:, :1]])
        spline = CubicSpline(*closed, 1, bc_type="periodic")
        at = np.arange(self._points) / self._points
        return np.ascontiguousarray(spline(at), dtype=np.float64)


def average_cycle(label: str, phase: F64, values: F64, period: float, points: int) -> F64:
    """Average cycles into one, at points evenly spaced in time, see :class:`CycleMean`.

    Args:
        label: Named in errors.
        phase: float64[n], time in periods since the start of the first cycle.
        values: float64[m, n], signals.
        period: Samples a period.
        points: Points wanted.

    Returns:
        float64[m, points]; the first point has phase 0.

    Raises:
        DataError: The period is too short, or samples are missing around a phase.
    """
    mean = CycleMean(label, period, points, len(values))
    mean.add(phase, values)
    return mean.cycle()


def loops_from_recording(
    recording: Recording, points: int = 300, labels: Collection[str] = ()
) -> tuple[SteadyLoop, ...]:
    """Return the averaged steady cycle of each segment, see :func:`loops_from_pieces`."""
    return loops_from_pieces([recording], points, labels)


def loops_from_pieces(
    pieces: Iterable[Recording], points: int = 300, labels: Collection[str] = ()
) -> tuple[SteadyLoop, ...]:
    """Return the averaged steady cycle of each segment of a recording.

    Samples with a displacement that is not finite are left out.

    Args:
        pieces: A run with at least one repeating segment, see
            :class:`hilctl.recording.reader.RecordingStream`.
        points: Points a loop; published are 200, 300 and 400.
        labels: Segments to take, by label; all where empty.

    Raises:
        DataError: A label is unknown, a segment has no steady cycle, or there is no segment.
    """
    found: list[_SegmentMean] | None = None
    for piece in pieces:
        if found is None:
            segments = _chosen(piece, labels)
            found = [_SegmentMean(piece, segment, points) for segment in segments]
        for each in found:
            each.add(piece)
    return tuple(each.loop() for each in found or ())


def _chosen(recording: Recording, labels: Collection[str]) -> list[Segment]:
    known = [segment.label for segment in recording.segments]
    unknown = [label for label in labels if label not in known]
    if unknown or not known:
        raise DataError(
            f"{recording.path}: no segment {', '.join(map(repr, unknown))}".rstrip()
            + f"; it has {', '.join(map(repr, known)) or 'none'}"
        )
    return [segment for segment in recording.segments if not labels or segment.label in labels]


class _SegmentMean:
    """The mean cycle of one segment of a recording that comes in pieces."""

    def __init__(self, recording: Recording, segment: Segment, points: int) -> None:
        where = f"{recording.path}: segment {segment.label!r}"
        self._start, self._stop, cycles = segment.steady_cycles()
        if cycles == 0:
            raise DataError(
                f"{where}: no steady cycle (period {segment.period:g} samples, full amplitude from "
                f"{segment.steady_start} to {segment.steady_stop}): run it longer or leave it out"
            )
        self._segment, self._rate_hz = segment, recording.sample_rate_hz
        self._mean = CycleMean(where, segment.period, points, 2)

    def add(self, piece: Recording) -> None:
        samples = piece.samples.part(self._start, self._stop)
        good = np.isfinite(samples.displacement_um)
        phase = (samples.index[good] - self._start) / self._segment.period
        self._mean.add(phase, np.stack([samples.command[good], samples.displacement_um[good]]))

    def loop(self) -> SteadyLoop:
        frequency_hz = self._rate_hz / self._segment.period
        command, displacement_um = self._mean.cycle()
        return SteadyLoop(
            self._segment.label, command, displacement_um, frequency_hz, self._rate_hz
        )


def find_cycles(history: History, points: int = 300) -> SteadyLoop:
    """Find the steady periodic part of a history and return its averaged cycle.

    The period is that of the command; the first cycle of the steady part is left out where there
    is more than one, because the hysteresis has yet to forget what came before.

    Args:
        history: Samples that repeat at full amplitude for two cycles at least.
        points: Points a loop.

    Raises:
        DataError: Nothing repeats.
    """
    command = history.command[history.ignore :]
    displacement_um = history.displacement_um[history.ignore :]
    period, start, stop = find_period(history.label, command)
    cycles = max(int((stop - start) / period + 1e-9) - 1, 1)
    start = max(stop - round(cycles * period), start)
    phase = np.arange(stop - start) / period
    values = np.stack([command[start:stop], displacement_um[start:stop]])
    v, y = average_cycle(history.label, phase, values, period, points)
    return SteadyLoop(history.label, v, y, history.sample_rate_hz / period, history.sample_rate_hz)
