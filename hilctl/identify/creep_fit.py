"""Fit of creep to the displacement while the command is constant.

During such rests neither hysteresis nor settled dynamics move the displacement. So creep is fitted
first and removed from the records, and models are fitted to the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from hilctl.base.types import F64, I64
from hilctl.identify.data.records import FEWEST_POINTS, History, Record
from hilctl.models.linear_stages import CreepModel

COARSE_S = 1e-3
LEAST_REST_S = 0.5
STILL = 1e-6  # of the command's range, from sample to sample
SETTLED_S = 0.01  # start of a rest that is ignored, until lags and structures have settled
SHORTEST_S = 0.03  # time constant
LONGEST = 10.0  # longest time constant, of the longest rest: slower creep looks linear
APART = 2.0  # ratio of time constants, which approximate any law of creep
FIRST_S, GROWTH = 0.005, 1.3  # first averaged interval of a rest, and ratio to the next
ROUNDS = 4  # of a fixed-point iteration: each leaves a few percent of the error
LEAST_SHARE = 1e-4
CLEAR = 0.8  # part of the motion during rests that creep must explain
MOST = 0.5  # maximum total share: a larger one is drift
LEAST = 3e-4  # of the stroke: minimum motion during rests


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
    """Return the creep during rests; None if there is none, or fewer than two rests of 0.5 s."""
    histories = [_coarse(record) for record in records if isinstance(record, History)]
    rests = [rest for i, history in enumerate(histories) for rest in _rests(i, history)]
    if len(rests) < 2:
        return None
    least_squares = _LeastSquares(histories, rests)
    creep = None
    for _ in range(ROUNDS):
        creep = least_squares.solve([_bare_um(history, creep) for history in histories])
        if creep is None:
            return None
    return creep


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
    whole = np.stack((history.command, history.displacement_um))[:, : count * together]
    command, displacement_um = whole.reshape(2, count, together).mean(axis=2)
    return History(history.label, command, displacement_um, history.sample_rate_hz / together)


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


def _bare_um(history: History, creep: CreepModel | None) -> F64:
    """Return a displacement less its first value and without creep: float64[n]."""
    y_um: F64 = history.displacement_um - history.displacement_um[0]
    return y_um if creep is None else creep.inverse(history.sample_rate_hz).process(y_um)


class _LeastSquares:
    """Least-squares fit of shares of given time constants, with heat and drift beside them."""

    def __init__(self, histories: Sequence[History], rests: Sequence[_Rest]) -> None:
        self._histories, self._rests = histories, rests
        longest_s = max(
            (rest.edges[-1] - rest.edges[0]) / histories[rest.of].sample_rate_hz for rest in rests
        )
        count = 1 + int(np.log(LONGEST * longest_s / SHORTEST_S) / np.log(APART))
        self._times_s = SHORTEST_S * APART ** np.arange(count, dtype=np.float64)
        heat = self._means([np.cumsum(history.command**2) for history in histories])
        drift = self._means([history.time_s for history in histories])
        self._others = np.linalg.qr(np.stack((heat, drift), axis=1))[0]
        measured = self._means([history.displacement_um for history in histories])
        self._measured_um = self._rest_of(measured)
        self._least_um = LEAST * max(float(np.ptp(each.displacement_um)) for each in histories)

    def solve(self, bare_um: Sequence[F64]) -> CreepModel | None:
        """Return the creep of displacements, float64[n] each; None if there is none."""
        moves = np.stack([self._moved(bare_um, time_s) for time_s in self._times_s], axis=1)
        shares, left = nnls(moves, self._measured_um)
        explained = 1.0 - (left / max(float(np.linalg.norm(self._measured_um)), 1e-300)) ** 2
        worth = shares > LEAST_SHARE
        moved_um = float(np.abs(moves @ shares).max())
        if explained < CLEAR or shares.sum() > MOST or not moved_um > self._least_um:
            return None
        return CreepModel(
            time_constants_s=tuple(self._times_s[worth].tolist()),
            shares=tuple(shares[worth].tolist()),
        )

    def _moved(self, bare_um: Sequence[F64], time_s: float) -> F64:
        """Return the motion of an element of share 1 during rests: float64[M]."""
        element = CreepModel(time_constants_s=(time_s,), shares=(1.0,))
        crept = [
            element.forward(history.sample_rate_hz).process(x_um) - x_um
            for history, x_um in zip(self._histories, bare_um, strict=True)
        ]
        return self._rest_of(self._means(crept))

    def _means(self, signals: Sequence[F64]) -> F64:
        return np.concatenate([rest.means(signals[rest.of]) for rest in self._rests])

    def _rest_of(self, means: F64) -> F64:
        """Return the part that heat and drift do not explain."""
        return means - self._others @ (self._others.T @ means)
