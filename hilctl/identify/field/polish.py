"""Stages and thresholds of the whole model followed down together, its weights following.

A search on fewer operators ends where these do best, which is not where all of them do: what small
loops miss of a model is a lag a little off, and thresholds beside those at which the rods yield.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.arrays import F64, I64
from hilctl.identify.field.descent import Place, settle
from hilctl.identify.field.stages import HIGH, LOW, NAMES, STEP, row
from hilctl.identify.field.weights import Equations, Grid, outputs, table

TRIED = 0.2  # of a unit: change that slopes are taken by; kinks of single rows are smoothed
MOVES = 0.1  # of the way to the next: change of a threshold that makes about as much difference
ROOM = 0.45  # the same: how far one may go from where the search has laid it
STAGES = len(NAMES)


@dataclass(frozen=True, slots=True)
class Bare:
    """What stages make of the records.

    Attributes:
        fields: For each record, float64[n], its effective field.
        y: float64[N], displacement of the rows without structure and delay, in um.
        scale: float64[N], square root of each row's weight.
    """

    fields: Sequence[F64]
    y: F64
    scale: F64


class Polish:
    """A sum of squares over stages and thresholds.

    Args:
        rows_of: From stages, float64[9], to the rows.
        paths: For each record int64[N_i], the samples that are rows.
        grid: The operators; their thresholds are where to start.
        least: Smallest slope of the first line, um per command unit.
    """

    def __init__(
        self, rows_of: Callable[[F64], Bare], paths: Sequence[I64], grid: Grid, least: float
    ) -> None:
        self._rows_of, self._paths, self._grid, self._least = rows_of, paths, grid, least
        self._tried: tuple[F64, Equations, Bare] | None = None

    def follow(self, stages: F64) -> tuple[F64, Grid]:
        """Return the stages and the operators where the sum is least."""
        first = self._grid.thresholds[1:]
        below = np.diff(self._grid.thresholds)
        above = np.append(below[1:], below[-1:])
        unit = np.concatenate((row(STEP), MOVES * below))
        # Each goes less than halfway to its neighbours, so that they stay in order.
        low = np.concatenate((row(LOW), first - ROOM * below))
        high = np.concatenate((row(HIGH), first + ROOM * above))
        x = settle(
            lambda point: self._equations(point)[0].solve().squares,
            lambda point: self._place(point, unit, high),
            np.concatenate((stages, first)),
            (low, high),
            unit,
        )
        return x[:STAGES], self._laid(x)

    def _laid(self, x: F64) -> Grid:
        return replace(self._grid, thresholds=np.append(0.0, x[STAGES:]))

    def _equations(self, x: F64) -> tuple[Equations, Bare]:
        """Return the equations of a point: a step is tried first, and taken from there."""
        if self._tried is None or not np.array_equal(self._tried[0], x):
            rows, grid = self._rows_of(x[:STAGES]), self._laid(x)
            columns = table(rows.fields, self._paths, grid)
            equations = Equations(columns, rows.y, grid, self._least, rows.scale)
            self._tried = x.copy(), equations, rows
        return self._tried[1:]

    def _place(self, x: F64, unit: F64, high: F64) -> Place:
        equations, rows = self._equations(x)
        grid, found = self._laid(x), equations.solve()
        changes = np.empty((rows.y.size, x.size))
        given, changes[:, STAGES:] = outputs(rows.fields, self._paths, grid, found.slopes)
        here = found.errors_of(given, rows.y)
        for i in range(STAGES):
            there = x.copy()
            there[i] += TRIED * unit[i] if x[i] + TRIED * unit[i] <= high[i] else -TRIED * unit[i]
            moved = self._rows_of(there[:STAGES])
            given, _ = outputs(moved.fields, self._paths, grid, found.slopes)
            errors = found.errors_of(given, moved.y)
            changes[:, i] = (errors * moved.scale / rows.scale - here) / (there[i] - x[i])
        return equations.place(here, changes)
