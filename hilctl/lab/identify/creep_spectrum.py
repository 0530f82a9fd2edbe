"""Creep of histories as a spectrum: weights of time constants in even steps of a logarithm.

Creep is told from hysteresis by time: plays of the command do not depend on it. So displacements,
averaged over milliseconds, are fitted by plays with densities that depend on the place, and by
elements of creep beside them, in one non-negative least squares, with lag, heat, drift and offsets.
All motions count, not only rests: the means of loops wander as creep does.

While the command is constant, neither hysteresis nor settled dynamics move the displacement. So
rests tell whether there is creep, and whether the result explains it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.optimize import minimize_scalar, nnls

from hilctl.base.types import F64, I64, Mask
from hilctl.kernels.field import play_paths
from hilctl.lab.identify.data.records import FEWEST_POINTS, History, Record
from hilctl.lab.identify.field.design_matrix import play_columns
from hilctl.models.linear_stages import LEAST_SLOPE, CreepModel, unbending
from hilctl.signals import cycle_metrics

COARSE_S = 1e-3
LEAST_REST_S = 0.5
STILL = 1e-6  # largest change per sample at rest, as a share of the command's range
SETTLED_S = 0.01  # start of a rest that is ignored, until lags and structures have settled
FIRST_S, GROWTH = 0.005, 1.3  # first averaged interval of a rest, and ratio to the next
UNCLEAR = 0.2  # part of the motion during rests that creep may leave, in squares
LEAST_MOVE = 3e-4  # minimum motion during rests, as a share of the stroke

WINDOW_S = 0.005  # displacements are averaged over: longer than lags and structures
MOST_WINDOWS = 20_000
STEPS = 50  # of the command's path, per window
PLAYS, SPLINES = 16, 8
NARROW, WIDE = 0.02, 0.8  # thresholds of the plays, of half the range
SHORTEST_S = 0.01  # time constant
APART = 10.0**0.5  # ratio of time constants, which approximate any law of creep
ROUNDS = 5  # of a fixed-point iteration: each leaves a few percent of the error
SURE, UNSURE = 1e-3, 0.05  # error of a window: of the stroke, and of the motion within it
RIDGE = 1e-6
FAST_S = 0.02  # longest time constant that may be that of losses
SYSTEMATIC = 0.1  # weight of motions per inverse error: unlike noise, that of plays repeats
LEAST_TRUST = 1e-4
LEAST_SHARE = 1e-4
MOST = 0.5  # maximum total share: a larger one is drift
EARLIER_S = 0.2  # shortest time constant of what earlier motions leave
SHARED = 3  # columns that all records share: lag, heat, drift
BENT = 0.5  # unexplained motion during rests with a bend, over the one without, if creep is bent
MOST_BENT = 10.0  # largest bend, per stroke


@dataclass(frozen=True, slots=True)
class _Rest:
    """An interval of constant command in a history, and edges of its averaged parts."""

    of: int
    edges: I64

    def means(self, signal: F64) -> F64:
        """Return the mean of a signal in each part, less their mean: float64[m]."""
        sums = np.add.reduceat(signal[: self.edges[-1]], self.edges[:-1])
        means: F64 = sums / np.diff(self.edges)
        means -= means.mean()
        return means


def creep_of(records: Sequence[Record]) -> CreepModel | None:
    """Return the creep of histories; None without creep or two rests of 0.5 s."""
    rests = _Rests(records)
    if not rests.move:
        return None
    spectrum = _Spectrum([record for record in records if isinstance(record, History)])
    straight = spectrum.solve(0.0)
    found = [straight, spectrum.solve(spectrum.bend())]
    left = [1.0 if creep is None else rests.unexplained(creep) for creep in found]
    # A bend may also suit the shape of the hysteresis, of which rests show nothing.
    best = int(left[1] < BENT * left[0])
    return found[best] if left[best] < UNCLEAR else None


def without_fastest(creep: CreepModel) -> CreepModel | None:
    """Return creep without elements as fast as losses may be; None if there are no others."""
    slow = [time_s > FAST_S for time_s in creep.time_constants_s]
    if not any(slow):
        return None
    kept = {
        name: tuple(compress(getattr(creep, name), slow)) for name in ("time_constants_s", "shares")
    }
    return creep.model_copy(update=kept)


def creeps(records: Sequence[Record]) -> bool:
    """Return whether displacements move during rests, other than by heat and drift."""
    return _Rests(records).move


def without_creep(records: Sequence[Record], creep: CreepModel) -> tuple[Record, ...]:
    """Return records with creep removed from histories."""
    return tuple(
        replace(record, displacement_um=_bare_um(record, creep) + record.displacement_um[0])
        if isinstance(record, History)
        else record
        for record in records
    )


def _coarse(history: History) -> History:
    """Return a history averaged over milliseconds: creep is slower by far."""
    together = max(1, int(COARSE_S * history.sample_rate_hz))
    count = history.command.size // together
    if together == 1 or count < FEWEST_POINTS:
        return history
    signals = (history.command, history.displacement_um)
    command, displacement_um = (_averaged(signal, together) for signal in signals)
    return History(history.label, command, displacement_um, history.sample_rate_hz / together)


def _averaged(signal: F64, together: int) -> F64:
    """Return the means of so many samples each."""
    count = len(signal) // together
    parts = signal[: count * together].reshape(count, together, *signal.shape[1:])
    return np.asarray(parts.mean(axis=1))


def _rests(number: int, history: History) -> Iterator[_Rest]:
    """Yield the rests of a history."""
    rate_hz = history.sample_rate_hz
    still = np.abs(np.diff(history.command)) <= STILL * np.ptp(history.command)
    turns = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    for start, stop in turns.reshape(-1, 2).tolist():
        if stop - start >= LEAST_REST_S * rate_hz:
            yield _Rest(number, _edges(start, stop + 1, rate_hz))


def _edges(start: int, stop: int, rate_hz: float) -> I64:
    """Return edges of parts that become longer, as creep becomes slower."""
    parts = int(np.log1p((stop - start) / rate_hz * (GROWTH - 1.0) / FIRST_S) / np.log(GROWTH))
    ends_s = SETTLED_S + FIRST_S * (GROWTH ** np.arange(parts + 1) - 1.0) / (GROWTH - 1.0)
    edges = np.unique(start + np.round(rate_hz * ends_s).astype(np.int64))
    return np.append(edges[edges < stop], stop)


def _bare_um(history: History, creep: CreepModel) -> F64:
    """Return a displacement less its first value and without creep: float64[n]."""
    y_um = history.displacement_um - history.displacement_um[0]
    return creep.inverse(history.sample_rate_hz).process(y_um)


class _Rests:
    """Motion of displacements during rests, without that of heat and drift."""

    def __init__(self, records: Sequence[Record]) -> None:
        self._histories = [_coarse(record) for record in records if isinstance(record, History)]
        histories = self._histories
        self._all = [rest for i, each in enumerate(histories) for rest in _rests(i, each)]

    @property
    def move(self) -> bool:
        """Whether the motion during rests is clear."""
        if len(self._all) < 2:
            return False
        # The noise of the shortest parts alone reaches the least motion at low sample rates.
        stroke_um = max(float(np.ptp(each.displacement_um)) for each in self._histories)
        return cycle_metrics.rms(self._measured_um) > LEAST_MOVE * stroke_um

    def unexplained(self, creep: CreepModel) -> float:
        """Return the part of the squared motion that creep does not explain."""
        bare_um = self._moved([_bare_um(history, creep) for history in self._histories])
        return float(bare_um @ bare_um) / float(self._measured_um @ self._measured_um)

    @cached_property
    def _measured_um(self) -> F64:
        return self._moved([history.displacement_um for history in self._histories])

    @cached_property
    def _others(self) -> F64:
        heat = self._means([np.cumsum(history.command**2) for history in self._histories])
        drift = self._means([history.time_s for history in self._histories])
        return np.linalg.qr(np.stack((heat, drift), axis=1))[0]

    def _moved(self, signals: Sequence[F64]) -> F64:
        means = self._means(signals)
        return np.asarray(means - self._others @ (self._others.T @ means))

    def _means(self, signals: Sequence[F64]) -> F64:
        return np.concatenate([rest.means(signals[rest.of]) for rest in self._all])


@dataclass(frozen=True, slots=True)
class _Path:
    """A history in steps of its command, of which some make a window."""

    command: F64
    displacement_um: F64
    rate_hz: float
    together: int  # steps of a window
    kept: Mask  # whether a window is evaluated

    @classmethod
    def of(cls, history: History, window_s: float) -> "_Path":
        window = max(1, round(window_s * history.sample_rate_hz))
        step = max(1, window // STEPS)
        together = window // step
        whole = step * together
        left_out = _averaged((~history.evaluated()).astype(np.float64), whole)
        count = left_out.size * whole
        y_um = _averaged(history.displacement_um[:count], step)
        command = _averaged(history.command[:count], step)
        rate_hz = history.sample_rate_hz / step
        return cls(command, y_um, rate_hz, together, left_out == 0.0)

    @property
    def time_s(self) -> F64:
        """Time of each step: float64[m]."""
        return np.arange(self.command.size) / self.rate_hz

    def means(self, signal: F64) -> F64:
        """Return the mean of a signal in each window: float64[n]."""
        return _averaged(signal, self.together)

    def rests(self) -> F64:
        """Return which windows are of each rest, without its start: float64[n, rests]."""
        moves = np.abs(np.diff(self.command, prepend=np.nan))
        windows = ~(_averaged(moves, self.together) > STILL * np.ptp(self.command))
        turns = np.flatnonzero(np.diff(np.concatenate(([0], windows, [0]))))
        least = LEAST_REST_S * self.rate_hz / self.together
        settled = math.ceil(SETTLED_S * self.rate_hz / self.together)
        found = [each for each in turns.reshape(-1, 2).tolist() if each[1] - each[0] >= least]
        of = np.zeros((windows.size, len(found)))
        for k, (start, stop) in enumerate(found):
            of[start + settled : stop, k] = 1.0
        return of

    def plays(self, thresholds: F64, lowest: float, span: float) -> F64:
        """Return each play's output per spline in each window: float64[n, m]."""
        size = self.command.size
        held, by = np.empty((2, thresholds.size, size))
        rows = np.arange(size)
        play_paths(self.command, np.zeros(size), thresholds, 0.0, 0.0, 0.0, rows, held, by)
        out = np.empty((size // self.together, thresholds.size, SPLINES))
        columns = np.empty((size, SPLINES))
        for i in range(thresholds.size):
            play_columns(held[i : i + 1], lowest, span / (SPLINES - 2), SPLINES, columns)
            out[:, i] = columns.reshape(len(out), self.together, SPLINES).mean(axis=1)
        return out.reshape(len(out), -1)


class _Fitted(NamedTuple):
    """Result of least squares."""

    shares: F64  # of all time constants
    error_um: float  # root of the weighted mean square
    offset_um: float  # of histories that depend on earlier motion
    trust: float  # weight of motions, of that of rests


class _Spectrum:
    """Least squares of plays and creep on the displacements of all windows."""

    def __init__(self, histories: Sequence[History]) -> None:
        lengths_s = [float(history.time_s[-1]) for history in histories]
        window_s = max(WINDOW_S, sum(lengths_s) / MOST_WINDOWS)
        self._paths = [_Path.of(history, window_s) for history in histories]
        self._kept = np.concatenate([path.kept for path in self._paths])
        self._rests_um = np.array([float(history.displacement_um[0]) for history in histories])
        self._unknown = np.array([history.ignore > 0 for history in histories])
        if self._unknown.any():
            self._rests_um[self._unknown] = self._rests_um[self._unknown].mean()
        shortest_s = max(SHORTEST_S, 2.0 * window_s)
        count = 1 + max(0, int(np.log(max(lengths_s) / shortest_s) / np.log(APART)))
        self._times_s = shortest_s * APART ** np.arange(count, dtype=np.float64)
        # Before the first evaluated sample, shorter time constants have decayed.
        first_s = np.array(
            [max(each.ignore / each.sample_rate_hz, EARLIER_S) for each in histories]
        )
        self._late = self._unknown[:, None] & (self._times_s > first_s[:, None])
        low = min(float(path.command.min()) for path in self._paths)
        reach = 0.5 * (max(float(path.command.max()) for path in self._paths) - low)
        thresholds = reach * np.append(0.0, np.geomspace(NARROW, WIDE, PLAYS - 1))
        grid = thresholds, low - 0.1 * reach, 2.2 * reach
        plays = np.concatenate([path.plays(*grid) for path in self._paths])[self._kept]
        moved = np.ptp(plays, axis=0)
        self._plays = plays[:, moved > SURE * float(moved.max())]
        pairs = zip(self._paths, self._rests_um, strict=True)
        y_um = [path.displacement_um - rest_um for path, rest_um in pairs]
        self._stroke_um = max(map(np.ptp, y_um))
        self._ends_um = min(map(np.min, y_um)), max(map(np.max, y_um))
        parts = [y.reshape(-1, path.together) for y, path in zip(y_um, self._paths, strict=True)]
        within_um = np.concatenate([np.ptp(part, axis=1) for part in parts])[self._kept]
        self._rests = block_diag(*(path.rests() for path in self._paths))
        self._still = self._rests[self._kept].any(axis=1)
        self._weight = 1.0 / (1.0 + UNSURE / SURE * within_um / self._stroke_um)

    def bend(self) -> float:
        """Return the bend that fits best, in 1/um."""
        low_um, high_um = self._ends_um
        room, most = 1.0 - LEAST_SLOPE**2, MOST_BENT / self._stroke_um
        lowest = max(-0.25 * room / high_um, -most) if high_um > 0.0 else -most
        highest = min(-0.25 * room / low_um, most) if low_um < 0.0 else most
        found = minimize_scalar(
            lambda bend: self._fit(bend).error_um, bounds=(lowest, highest), method="bounded",
            options={"xatol": 0.02 * (highest - lowest)},
        )  # fmt: skip
        return float(found.x)

    def solve(self, bend: float) -> CreepModel | None:
        """Return the creep; None without creep."""
        found = None
        for _ in range(ROUNDS):
            found = self._fit(bend, found)
            if not (found.shares > LEAST_SHARE).any() or found.shares.sum() > MOST:
                return None
            # The offset is small, so that a bend hardly changes it.
            self._rests_um[self._unknown] += found.offset_um
        assert found is not None
        return self._creep(found, bend)

    def _creep(self, found: _Fitted, bend: float = 0.0) -> CreepModel:
        worth = found.shares > LEAST_SHARE
        return CreepModel(
            time_constants_s=tuple(self._times_s[worth].tolist()),
            shares=tuple(found.shares[worth].tolist()),
            bend_per_um=bend,
        )

    def _fit(self, bend: float, before: _Fitted | None = None) -> _Fitted:
        """Return the best shares, given the result of a round before."""
        pairs = zip(self._paths, self._rests_um, strict=True)
        unbent = [unbending(bend).process(path.displacement_um - rest) for path, rest in pairs]
        bare = unbent
        if before is not None:
            undone = [self._creep(before).inverse(path.rate_hz) for path in self._paths]
            bare = [inverse.process(y) for inverse, y in zip(undone, unbent, strict=True)]
        crept = [self._crept(time_s, bare) for time_s in self._times_s.tolist()]
        y = self._means(unbent)
        trust = 1.0 if before is None else before.trust
        own = self._weight * np.where(self._still, 1.0, trust)
        weight = own * (1.0 + 2.0 * bend * y)  # of errors in um
        others, corner = np.linalg.qr(self._others(unbent) * weight[:, None])
        columns = np.column_stack([self._plays, *crept]) * weight[:, None]
        target = y * weight
        by_others, of_others = others.T @ columns, others.T @ target
        columns -= others @ by_others
        target -= others @ of_others
        longest = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        columns /= longest
        normal = columns.T @ columns
        normal[np.diag_indices_from(normal)] += RIDGE
        factor = cholesky(normal)
        found, _ = nnls(
            factor,
            solve_triangular(factor, columns.T @ target, trans=1),
            maxiter=100 * longest.size,
        )
        error = target - columns @ found
        error_um = float(np.sqrt(error @ error / (own @ own)))
        still, moving = (cycle_metrics.rms(error[at]) for at in (self._still, ~self._still))
        trust = float(np.clip(SYSTEMATIC * still * trust / max(moving, 1e-300), LEAST_TRUST, 1.0))
        found /= longest
        free = solve_triangular(corner, of_others - by_others @ found)
        offset_um = float(free[SHARED]) if self._unknown.any() else 0.0
        return _Fitted(found[-self._times_s.size :], error_um, offset_um, trust)

    def _others(self, unbent: Sequence[F64]) -> F64:
        """Return what else moves a displacement: float64[n, k].

        Lag, heat and drift; an offset per history, which those that depend on earlier motion share,
        and their earlier creep; an offset per rest, since plays hardly predict where it is.
        """
        paths = self._paths
        lag = [np.gradient(path.means(y)) for path, y in zip(paths, unbent, strict=True)]
        heat = [path.means(np.cumsum(path.command**2) / path.rate_hz) for path in paths]
        drift = [path.means(path.time_s) for path in paths]
        shared = np.stack([np.concatenate(part) for part in (lag, heat, drift)], axis=1)
        number = np.repeat(np.arange(len(paths)), [path.kept.size for path in paths])
        within = number[:, None] == np.arange(len(paths))
        parts = [shared]
        if self._unknown.any():
            parts.append(within[:, self._unknown].any(axis=1, keepdims=True))
            for path, late, own in zip(paths, self._late, within.T, strict=True):
                earlier = np.zeros((number.size, int(late.sum())))
                decays = np.exp(-path.time_s[:, None] / self._times_s[late])
                earlier[own] = _averaged(decays, path.together)
                parts.append(earlier)
        parts.append(within[:, ~self._unknown])
        return np.asarray(np.hstack([*parts, self._rests])[self._kept])

    def _crept(self, time_s: float, bare: Sequence[F64]) -> F64:
        """Return the creep of an element of share 1: float64[n]."""
        element = CreepModel(time_constants_s=(time_s,), shares=(1.0,))
        pairs = zip(self._paths, bare, strict=True)
        return self._means([element.forward(path.rate_hz).process(x) - x for path, x in pairs])

    def _means(self, signals: Sequence[F64]) -> F64:
        pairs = zip(self._paths, signals, strict=True)
        means = np.concatenate([path.means(signal) for path, signal in pairs])
        return np.asarray(means[self._kept])
