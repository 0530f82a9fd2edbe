"""How well the loop kept its time: pure functions of tick arrays."""

import numpy as np

from hilctl.base.arrays import I64
from hilctl.recording.data import Ticks

MOST_ROWS = 1440
"""Most stretches that lateness is given for: a day has as many minutes."""

_MINUTE_NS = 60_000_000_000
_PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9}


def percentiles_us(times_ns: I64) -> dict[str, float]:
    """Return ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max`` in us of int64[m] in ns.

    Empty where there is none.
    """
    if times_ns.size == 0:
        return {}
    values = np.percentile(times_ns, list(_PERCENTILES.values())) * 1e-3
    figures = dict(zip(_PERCENTILES, values.tolist(), strict=True))
    return {**figures, "max": float(times_ns.max()) * 1e-3}


def by_minute(ticks: Ticks) -> list[dict[str, float]]:
    """Return the lateness of each minute of a run, in order.

    Returns:
        For each minute with ticks: ``minute`` from 0, its ``ticks``, and the figures of
        :func:`percentiles_us`. Of a run longer than a day, for stretches of several minutes, with
        the first of them.
    """
    if ticks.deadline_ns.size == 0:
        return []
    minutes = ticks.deadline_ns // _MINUTE_NS
    together = 1 + int(minutes.max() - minutes.min()) // MOST_ROWS
    minutes = minutes // together * together
    numbers, first = np.unique(minutes, return_index=True)  # deadlines rise, so do minutes
    parts = np.split(ticks.late_ns, first[1:])
    return [
        {"minute": int(number), "ticks": part.size, **percentiles_us(part)}
        for number, part in zip(numbers.tolist(), parts, strict=True)
    ]


def tick_period_ns(ticks: Ticks) -> float | None:
    """Return the usual time from one tick's deadline to the next; None with fewer than two."""
    if ticks.deadline_ns.size < 2:
        return None
    return float(np.median(np.diff(ticks.deadline_ns)))


def late_ticks(ticks: Ticks) -> int | None:
    """Count ticks that woke more than half a tick period late; None with fewer than two ticks."""
    period_ns = tick_period_ns(ticks)
    return None if period_ns is None else int(np.count_nonzero(ticks.late_ns > 0.5 * period_ns))
