"""Steady cycles: found, averaged, and resampled to a number of points a loop."""

from collections.abc import Collection

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.identify.data.period import find_period
from hilctl.identify.data.records import FEWEST_POINTS, History, SteadyLoop
from hilctl.recording.data import Recording

_LARGEST = 1e100  # no reading is; the spline's differences and products stay finite below it


def average_cycle(label: str, phase: F64, values: F64, period: float, points: int) -> F64:
    """Average cycles into one, at points evenly spaced in time.

    Samples fall into bins around evenly spaced phases, no more bins than samples a period, so
    that a period of any length, whole or not, fills all of them. A bin's mean stands at its
    samples' mean phase; a periodic spline through them gives the points.

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
    bins = min(points, int(period + 1e-9))
    if bins < FEWEST_POINTS:
        raise DataError(
            f"{label}: needs at least {FEWEST_POINTS} samples and points a cycle, got "
            f"{period:g} samples and {points} points"
        )
    nearest = np.floor(phase * bins + 0.5)
    index = nearest.astype(np.int64) % bins
    count = np.bincount(index, minlength=bins)
    if not count.all():
        missing = int(np.argmin(count))
        raise DataError(
            f"{label}: no sample at {missing / bins:.3f} of the cycle in any cycle: samples are "
            "missing in the data"
        )
    offset = np.bincount(index, phase * bins - nearest, bins) / count
    knots = (np.arange(bins) + offset) / bins
    means = np.array([np.bincount(index, row, bins) / count for row in values])
    if not (np.abs(means) < _LARGEST).all():
        raise DataError(f"{label}: holds values that are not finite, or too large to be averaged")
    spline = CubicSpline(
        np.append(knots, knots[0] + 1.0), np.hstack([means, means[:, :1]]), 1, bc_type="periodic"
    )
    return np.ascontiguousarray(spline(np.arange(points) / points), dtype=np.float64)


def loops_from_recording(
    recording: Recording, points: int = 300, labels: Collection[str] = ()
) -> tuple[SteadyLoop, ...]:
    """Return the averaged steady cycle of each segment of a recording.

    Samples with a displacement that is not finite are left out.

    Args:
        recording: A run with at least one repeating segment.
        points: Points a loop; published are 200, 300 and 400.
        labels: Segments to take, by label; all where empty.

    Raises:
        DataError: A label is unknown, a segment has no steady cycle, or there is no segment.
    """
    known = [segment.label for segment in recording.segments]
    unknown = [label for label in labels if label not in known]
    if unknown or not known:
        raise DataError(
            f"{recording.path}: no segment {', '.join(map(repr, unknown))}".rstrip()
            + f"; it has {', '.join(map(repr, known)) or 'none'}"
        )
    chosen = [segment for segment in recording.segments if not labels or segment.label in labels]
    return tuple(_segment_loop(recording, segment, points) for segment in chosen)


def _segment_loop(recording: Recording, segment: Segment, points: int) -> SteadyLoop:
    where = f"{recording.path}: segment {segment.label!r}"
    start, stop, cycles = segment.steady_cycles()
    if cycles == 0:
        raise DataError(
            f"{where}: no steady cycle (period {segment.period:g} samples, full amplitude from "
            f"{segment.steady_start} to {segment.steady_stop}): run it longer or leave it out"
        )
    samples = recording.samples.part(start, stop)
    good = np.isfinite(samples.displacement_um)
    phase = (samples.index[good] - start) / segment.period
    values = np.stack([samples.command[good], samples.displacement_um[good]])
    command, displacement_um = average_cycle(where, phase, values, segment.period, points)
    return SteadyLoop(
        segment.label,
        command,
        displacement_um,
        recording.sample_rate_hz / segment.period,
        recording.sample_rate_hz,
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
