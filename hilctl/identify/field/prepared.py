"""Records as the fit needs them: thinned in time, the displacement ready to lose its structure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.arrays import F64
from hilctl.identify.data.records import Record, Records, SteadyLoop
from hilctl.models.chain import smoothing_weights

POINTS = 45  # samples that are left of the fastest cycle
SMOOTHED = 0.09  # of a radian of the fastest cycle: how far the displacement is smoothed


@dataclass(frozen=True)
class Run:
    """One record.

    Attributes:
        step_s: Time between samples.
        command: float64[n], mean command over the step that ends at each sample.
        derivatives: float64[3, n], displacement in um and its first two derivatives by time.
        judged: First sample that counts.
    """

    step_s: float
    command: F64
    derivatives: F64
    judged: int

    @cached_property
    def time_s(self) -> F64:
        """Time of each sample."""
        return np.asarray(np.arange(self.command.size) * self.step_s, dtype=np.float64)

    def bare_um(self, delay_s: float, slope_s: float, bend_s2: float) -> F64:
        """Return the displacement before delay and structure: float64[n]."""
        y, slope, bend = self.derivatives
        whole: F64 = y + slope_s * slope + bend_s2 * bend
        if delay_s == 0.0:
            return whole
        return np.asarray(np.interp(self.time_s + delay_s, self.time_s, whole))


class Prepared:
    """All records.

    Attributes:
        runs: The records.
        reach: Half the largest peak-to-peak command.
        stroke_um: Largest peak-to-peak displacement.
        top_hz: Frequency of a sine that is as fast as the fastest record.
    """

    def __init__(self, records: Records) -> None:
        """Smooth and thin records."""
        self.reach = max(0.5 * float(np.ptp(record.command)) for record in records)
        self.stroke_um = max(float(np.ptp(record.displacement_um)) for record in records)
        self.top_hz = max(_speed(record) for record in records) / (2.0 * math.pi * self.reach)
        self.runs: Sequence[Run] = tuple(_run(record, self.top_hz) for record in records)


def _speed(record: Record) -> float:
    """Return the largest rate of a command; noise on a measured one is told from it."""
    _, rate, _ = record.run()
    return float(np.quantile(np.abs(rate), 0.999))


def _run(record: Record, top_hz: float) -> Run:
    command, displacement_um, rate_hz, judged = _whole(record)
    width = min(SMOOTHED / (2.0 * math.pi * top_hz), 1.0) * rate_hz
    plain, ahead = smoothing_weights(width)
    by_slope = smoothing_weights(width, slope_gain=rate_hz)[0] - plain
    by_bend = smoothing_weights(width, bend_gain=rate_hz**2)[0] - plain
    padded = np.pad(displacement_um, ahead, mode="edge")
    derivatives = np.stack(
        [np.convolve(padded, weights[::-1], "valid") for weights in (plain, by_slope, by_bend)]
    )
    thin = max(1, math.floor(rate_hz / (POINTS * top_hz)))
    kept = slice(0, command.size, thin)
    held = np.cumsum(np.concatenate(([command[0]], command)))
    index = np.arange(command.size)[kept]
    mean = np.empty(index.size)
    mean[0] = command[0]
    mean[1:] = np.diff(held[index]) / thin
    derivatives = np.ascontiguousarray(derivatives[:, kept])
    return Run(thin / rate_hz, mean, derivatives, -(-judged // thin))


def _whole(record: Record) -> tuple[F64, F64, float, int]:
    """Return command, displacement, rate and first judged sample of a record run from rest."""
    if not isinstance(record, SteadyLoop):
        return record.command, record.displacement_um, record.sample_rate_hz, record.ignore
    points = record.command.size
    rate_hz = points * record.frequency_hz
    command = record.command
    if record.sample_rate_hz > 0.0:
        # ``command[k - 1]`` counts as held from point k - 1 to k; in the run it was from then on
        # for a sample only, so it has to come later by what lies between the middles of the two.
        late_s = 0.5 / record.sample_rate_hz - 0.5 / rate_hz
        time_s = np.arange(points + 1) / rate_hz
        spline = CubicSpline(time_s, np.append(command, command[0]), bc_type="periodic")
        command = np.asarray(spline(time_s[:-1] - late_s), dtype=np.float64)
    return np.tile(command, 2), np.tile(record.displacement_um, 2), rate_hz, points
