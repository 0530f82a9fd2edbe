"""Percentiles in bounded memory; lateness of ticks and missed deadlines."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64
from hilctl.loop.pacer import USUAL_MISSED_SHARE, deadline_misses
from hilctl.recording.recording import Recording, Ticks

MOST_EXACT = 2**21
"""Largest number of values that are kept without reduction."""


class Quantiles:
    """Distribution of values."""

    def __init__(self) -> None:
        self.size = 0  # number of values
        self.total = 0.0
        self.largest = -math.inf  # -inf without any
        self._every = 1
        self._parts: list[Any] = []

    def add(self, values: F64 | I64) -> None:
        """Add values, float64[n] or int64[n], without NaN."""
        if values.size == 0:
            return
        self._parts.append(values[-self.size % self._every :: self._every].copy())
        self.size += values.size
        self.total += float(values.sum())
        self.largest = max(self.largest, float(values.max()))
        while self.size > self._every * MOST_EXACT:
            self._every *= 2
            self._parts = [np.concatenate(self._parts)[::2]]

    def percentiles(self, percents: Sequence[float]) -> list[float]:
        """Return percentiles as :func:`numpy.percentile`, of at least one value."""
        return list(np.percentile(np.concatenate(self._parts), percents).tolist())

    def median(self) -> float:
        """Return the median of at least one value."""
        return float(np.median(np.concatenate(self._parts)))


MOST_ROWS = 1440
"""Most rows of lateness by minute: the minutes of a day."""

_MINUTE_NS = 60_000_000_000
_PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9}


class LatenessBuilder:
    """Lateness of the ticks of a run so far, and the durations of their exchanges.

    A tick waits for its deadline, wakes up and computes (``late_ns``, from the deadline to the
    exchange), and exchanges its block (``exchange_ns``); ``busy_ns`` is the sum of both.

    ``minutes`` is the planned duration of the run; beyond a day, several minutes share a row.
    """

    def __init__(self, minutes: float) -> None:
        self._together = 1 + int(minutes) // MOST_ROWS
        self.late_ns, self.exchange_ns, self.busy_ns = Quantiles(), Quantiles(), Quantiles()
        self.period_ns: float | None = None
        """Median time from one deadline to the next; None before the second tick."""
        self._rows: list[dict[str, float]] = []
        self._minute, self._of_minute = 0, Quantiles()

    def add(self, ticks: Ticks) -> None:
        """Add the next ticks."""
        if ticks.late_ns.size == 0:
            return
        self.late_ns.add(ticks.late_ns)
        self.exchange_ns.add(ticks.exchange_ns)
        self.busy_ns.add(ticks.late_ns + ticks.exchange_ns)
        if self.period_ns is None and ticks.deadline_ns.size > 1:
            self.period_ns = float(np.median(np.diff(ticks.deadline_ns)))
        minutes = ticks.deadline_ns // _MINUTE_NS // self._together * self._together
        cuts = np.flatnonzero(np.diff(minutes)) + 1
        parts = np.split(ticks.late_ns, cuts)
        for number, part in zip(minutes[[0, *cuts]].tolist(), parts, strict=True):
            if number != self._minute and len(self._rows) < MOST_ROWS:
                self._end_row()
                self._minute = number
            self._of_minute.add(part)

    def _end_row(self) -> None:
        if self._of_minute.size:
            counted = {"minute": self._minute, "ticks": self._of_minute.size}
            self._rows.append({**counted, **percentiles_us(self._of_minute)})
        self._of_minute = Quantiles()

    def by_minute(self) -> list[dict[str, float]]:
        """Return the lateness of each minute with ticks, after the last tick.

        Each row has ``minute`` from 0 (the first, if several share a row), its ``ticks``, and the
        values of :func:`percentiles_us`.
        """
        self._end_row()
        return self._rows


def percentiles_us(times_ns: Quantiles) -> dict[str, float]:
    """Return ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max`` in us; empty without times."""
    if times_ns.size == 0:
        return {}
    values = [each * 1e-3 for each in times_ns.percentiles(list(_PERCENTILES.values()))]
    return {**dict(zip(_PERCENTILES, values, strict=True)), "max": times_ns.largest * 1e-3}


def parts_us(recording: Recording, ticks: LatenessBuilder) -> dict[str, float]:
    """Return the mean time in us that a tick takes to ``wake``, ``compute`` and ``exchange``.

    Empty if it is unknown. Raise DataError if a recorded number is invalid.
    """
    wake_ns, count = counter(recording, "mean_wake_ns"), ticks.late_ns.size
    if wake_ns is None or not count:
        return {}
    late_ns, exchange_ns = ticks.late_ns.total / count, ticks.exchange_ns.total / count
    return {
        "wake": wake_ns * 1e-3,
        "compute": (late_ns - wake_ns) * 1e-3,
        "exchange": exchange_ns * 1e-3,
    }


def misses(recording: Recording, ticks: int) -> str:
    """Return a text on the share of skipped ticks; empty if there are none or it is unknown.

    Raise DataError if a recorded number is invalid.
    """
    skipped = counter(recording, "skipped_ticks") or 0
    text = recording.run.get("max_missed_share", repr(USUAL_MISSED_SHARE))
    try:
        max_share = float(text)
    except ValueError:
        rule = "hilctl.run: max_missed_share must be a number"
        raise DataError(f"{recording.path}: {rule}, got {text!r}") from None
    return deadline_misses(skipped, ticks + skipped, max_share)


def counter(recording: Recording, name: str) -> int | None:
    """Return a counter of the end, or None; raise DataError if it is not a whole number."""
    if name not in recording.end:
        return None
    try:
        return int(recording.end[name])
    except ValueError:
        text = f"{recording.path}: hilctl.end: {name} must be a whole number"
        raise DataError(f"{text}, got {recording.end[name]!r}") from None
