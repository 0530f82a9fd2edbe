"""How well the loop kept its time."""

import numpy as np

from hilctl.base.arrays import I64
from hilctl.base.errors import DataError
from hilctl.experiment.parts import Timing
from hilctl.loop.pacer import deadline_misses
from hilctl.recording.data import Recording, Ticks

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


def misses(recording: Recording) -> str:
    """Return how many ticks a run has skipped, for people; empty where none or not known.

    Raises:
        DataError: A number that the recording says of it is none.
    """
    skipped = counter(recording, "skipped_ticks", None) or 0
    usual = Timing().max_missed_share
    text = recording.run.get("max_missed_share", repr(usual))
    try:
        max_share = float(text)
    except ValueError:
        rule = "hilctl.run: max_missed_share must be a number"
        raise DataError(f"{recording.path}: {rule}, got {text!r}") from None
    return deadline_misses(skipped, recording.ticks.late_ns.size + skipped, max_share)


def counter(recording: Recording, name: str, otherwise: int | None) -> int | None:
    """Return a counter from the record of the end, or what was counted otherwise.

    Raises:
        DataError: It is not a whole number.
    """
    if name not in recording.end:
        return otherwise
    try:
        return int(recording.end[name])
    except ValueError:
        text = f"{recording.path}: hilctl.end: {name} must be a whole number"
        raise DataError(f"{text}, got {recording.end[name]!r}") from None


def late_ticks(ticks: Ticks) -> int | None:
    """Count ticks that woke more than half a tick period late; None with fewer than two ticks."""
    period_ns = tick_period_ns(ticks)
    return None if period_ns is None else int(np.count_nonzero(ticks.late_ns > 0.5 * period_ns))
