"""Preparation of histories for a fit: smoothing, thinning, and removal of structure and delay."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from scipy.ndimage import uniform_filter1d

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64
from hilctl.lab.identify.data.records import History, Record, SteadyLoop
from hilctl.lab.identify.field.design_matrix import Motion, bare_displacement, corners
from hilctl.lab.identify.parallel import parallel_map
from hilctl.models.effective_field import final_weight
from hilctl.models.linear_stages import Compliance, smoothing_weights

WIDER = 4.0  # of the first width: the second
MEDIAN_SQUARE = 0.4549  # of normally distributed numbers with mean square 1
LEAST = 0.01  # part of the noise that a window must remove to tell its level


def smoothed(displacement_um: F64, width: float, rate_hz: float) -> F64:
    """Return the displacement and its first two derivatives by time: float64[3, n].

    A window narrow enough for the fastest loop leaves most of the sensor noise, which reverses the
    path in small and slow loops. So a second, wider window is used, and the difference of both is
    kept as far as it exceeds noise (J. S. Lee, IEEE Trans. Pattern Anal. Mach. Intell. 2 (1980)
    165). The noise follows from the residual of the first window.
    """
    plain, wide = smoothing_weights(width)[0], smoothing_weights(WIDER * width)[0]
    found = _derivatives(displacement_um, width, rate_hz)
    own = 1.0 - 2.0 * plain[plain.size // 2] + float(np.sum(plain**2))
    if own < LEAST or wide.size > displacement_um.size:
        return np.ascontiguousarray(found)
    noise = float(np.median((displacement_um - found[0]) ** 2)) / (MEDIAN_SQUARE * own)
    calm = _derivatives(displacement_um, WIDER * width, rate_hz)
    apart = wide.copy()
    apart[(wide.size - plain.size) // 2 :][: plain.size] -= plain
    off = uniform_filter1d((found[0] - calm[0]) ** 2, 2 * wide.size, mode="nearest")
    kept = 1.0 - noise * float(np.sum(apart**2)) / np.maximum(off, np.finfo(np.float64).tiny)
    return np.ascontiguousarray(calm + np.maximum(kept, 0.0) * (found - calm))


def _derivatives(y: F64, width: float, rate_hz: float) -> F64:
    plain = smoothing_weights(width)[0]
    by_slope = smoothing_weights(width, slope_gain=rate_hz)[0] - plain
    by_bend = smoothing_weights(width, bend_gain=rate_hz**2)[0] - plain
    return np.stack([_convolved(y, weights) for weights in (plain, by_slope, by_bend)])


def _convolved(y: F64, weights: F64) -> F64:
    """Return y convolved with an odd number of weights; the ends are repeated."""
    padded = np.pad(y, weights.size // 2, mode="edge")
    return np.convolve(padded, weights[::-1], "valid")


POINTS = 90  # samples kept of the fastest cycle
SMOOTHED = 0.09  # window, in radians of the fastest cycle
OFF = 5e-4  # deviation of straight lines from the displacement, of its peak-to-peak
COMMAND_OFF = 1e-4  # the same for commands, at whose turns the operators turn
SLOWEST_HZ = 0.35  # least top_hz: the longest lag, 1 s, belongs to it
LONGEST_DELAY = 0.3  # in radians of the fastest cycle
LONGEST = 0.3  # longest step, in cycles of the fastest
SAME_EVERYWHERE = 0.0, 1.0, np.ones(2)  # table of a compliance of 1


_Found = TypeVar("_Found")


class Latest(Generic[_Found]):
    """The last result of a computation, reused until a search changes its arguments."""

    def __init__(self) -> None:
        self._known: tuple[object, _Found] | None = None

    def of(self, key: object, work: Callable[[], _Found]) -> _Found:
        """Return the result for a key, computed by ``work`` if the key has changed."""
        known = self._known
        if known is None or known[0] != key:
            self._known = known = key, work()
        return known[1]


@dataclass(frozen=True, eq=False)
class Run:
    """One record; callers must not change returned arrays, since they are cached."""

    rate_hz: float
    kept: I64
    step_s: F64  # float64[n], time since the sample before
    command: F64  # float64[n], at the end of each step
    mean: F64  # float64[n], the command's mean over each step
    derivatives: F64  # float64[3, N], displacement of all samples in um and its derivatives by time
    motion: Motion
    noise_correlation: float = 0.0  # of the smoothed displacements of neighbouring samples
    compliance: Compliance | None = None  # of the structure, by displacement
    _late: Latest[tuple[F64, F64]] = field(default_factory=Latest, init=False, repr=False)
    _bare: Latest[F64] = field(default_factory=Latest, init=False, repr=False)

    @property
    def time_s(self) -> F64:
        """Time of each sample that is kept."""
        return self.kept / self.rate_hz

    def late_command(self, lag_s: float, decay_s: float) -> tuple[F64, F64]:
        """Return the part of each step at which to take its command, and the command."""
        # So a lag's step is exact: the middle of a short one, the end of one that settles.
        return self._late.of((lag_s, decay_s), lambda: self._late_command(lag_s, decay_s))

    def _late_command(self, lag_s: float, decay_s: float) -> tuple[F64, F64]:
        step_s = np.maximum(self.step_s, 1.0 / self.rate_hz)
        late = final_weight(lag_s / step_s, decay_s / step_s)
        # The command is a staircase, not a ramp, within a step of several samples.
        sample_s = np.array(1.0 / self.rate_hz)
        held = (final_weight(lag_s / sample_s, decay_s / sample_s) - 0.5) * sample_s / step_s
        return late, self.mean + 2.0 * (late - 0.5 - held) * (self.command - self.mean)

    def bare_um(self, delay_s: float, slope_s: float, bend_s2: float) -> F64:
        """Return the displacement before delay and structure: float64[n]."""
        key = delay_s, slope_s, bend_s2
        return self._bare.of(key, lambda: self._bare_um(*key))

    def noise_gain(self, delay_s: float) -> float:
        """Return the factor by which the interpolation of :meth:`bare_um` reduces sensor noise."""
        part = (delay_s * self.rate_hz) % 1.0
        return math.sqrt(1.0 - 2.0 * part * (1.0 - part) * (1.0 - self.noise_correlation))

    def _bare_um(self, delay_s: float, slope_s: float, bend_s2: float) -> F64:
        out = np.empty(self.kept.size)
        late = delay_s * self.rate_hz
        table = SAME_EVERYWHERE if self.compliance is None else self.compliance.table
        bare_displacement(self.derivatives, self.kept, late, (slope_s, bend_s2), table, out)
        return out


class Prepared:
    """All records, prepared; ``top_hz`` is the frequency of a sine as fast as the fastest one."""

    def __init__(
        self,
        records: Sequence[History],
        points: int = POINTS,
        command_off: float = COMMAND_OFF,
        compliance: Compliance | None = None,
    ) -> None:
        self._points, self._command_off = points, command_off
        self.compliance = compliance
        self.reach = max(0.5 * float(np.ptp(record.command)) for record in records)
        self.stroke_um = max(float(np.ptp(record.displacement_um)) for record in records)
        fastest = max(_speed(record) for record in records)
        self.top_hz = max(fastest / (2.0 * math.pi * self.reach), SLOWEST_HZ)
        self.runs: Sequence[Run] = parallel_map(self._run, records)

    def _run(self, record: History) -> Run:
        rate_hz, command = record.sample_rate_hz, record.command
        fast = 2.0 * math.pi * self.top_hz
        width = min(SMOOTHED / fast, 1.0) * rate_hz
        derivatives = smoothed(record.displacement_um, width, rate_hz)
        thin = max(1, math.floor(rate_hz / (self._points * self.top_hz)))
        furthest = max(thin, math.floor(LONGEST * rate_hz / self.top_hz))
        kept = np.empty(command.size, dtype=np.int64)
        off = 2.0 * self._command_off * self.reach, OFF * self.stroke_um
        count = corners(np.ascontiguousarray(command), derivatives[0], *off, thin, furthest, kept)
        kept = kept[:count].copy()
        steps = np.diff(kept, prepend=kept[0])
        at_end = 0.5 * (command[kept] + command[np.maximum(kept - 1, 0)])
        held = np.cumsum(np.concatenate(([command[0]], command)))
        mean = np.full(kept.size, command[0])
        mean[1:] = np.diff(held[kept]) / np.diff(kept)
        step_s, both = steps / rate_hz, (at_end, derivatives[0, kept])
        # Smoothing and delay need later samples, which the end of a record does not have.
        ahead = smoothing_weights(WIDER * width)[1] + LONGEST_DELAY * rate_hz / fast
        judged = record.evaluated()[kept] & (kept < command.size - ahead)
        motion = Motion.of(both, step_s, judged, self.reach, self.stroke_um)
        correlation = _noise_correlation(width)
        signals = step_s, at_end, mean, derivatives, motion
        return Run(rate_hz, kept, *signals, correlation, self.compliance)


def _noise_correlation(width: float) -> float:
    """Return the correlation of neighbouring samples' noise after :func:`smoothed`."""
    weights = smoothing_weights(width)[0]
    if weights.max() < 1.0 - LEAST:  # then the wider window determines the noise
        weights = smoothing_weights(WIDER * width)[0]
    return float(weights[1:] @ weights[:-1] / (weights @ weights))


def histories_of(records: Sequence[Record], what: str) -> list[History]:
    """Return the records if all are histories; raise DataError otherwise."""
    loops = [record.label for record in records if isinstance(record, SteadyLoop)]
    if loops:
        raise DataError(
            f"{what} needs whole histories, not steady loops such as '{loops[0]}': record the "
            "campaign configs/identify_any.yaml, or use --model staged for loops"
        )
    return [record for record in records if isinstance(record, History)]


def _speed(record: History) -> float:
    """Return the largest rate of a command; a quantile, because a measured one has noise."""
    return float(np.quantile(np.abs(record.rate()), 0.999))
