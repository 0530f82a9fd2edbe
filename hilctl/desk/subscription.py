"""Provide frames of a live run for programs: newest signals, metrics and events."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from hilctl.base.arrays import F64
from hilctl.base.events import Event
from hilctl.desk.feed import RunFeed
from hilctl.desk.frames import nearest_window_s
from hilctl.desk.signals import SIGNALS


@dataclass(frozen=True, slots=True)
class RunFrame:
    """A run at one time.

    Attributes:
        status: State, metrics, limits and lateness; see :meth:`RunFeed.status`.
        events: Events since the previous frame.
        t_s: float64[n], start of each bucket of samples; 0 is the end of the newest.
        low: Minimum of each bucket by signal, float64[n]; NaN if there is no value.
        high: Maximum of each bucket, likewise.
    """

    status: dict[str, Any]
    events: list[Event]
    t_s: F64
    low: dict[str, F64]
    high: dict[str, F64]


def frames_of(
    feed: RunFeed,
    every_s: float,
    window_s: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[RunFrame]:
    """Yield frames of a run until it has ended, the last one after its end.

    Args:
        feed: Reader of the run.
        every_s: Interval between frames; a late frame does not shorten the next interval.
        window_s: Time window of each frame; the nearest available one is used.
        clock: Monotonic time in s.
        sleep: Sleeps for the given time in s.
    """
    window_s, seen = nearest_window_s(window_s), 0
    while True:
        began_s = clock()
        feed.poll(began_s)
        ended = feed.ended
        events, seen = feed.events_since(seen)
        window = feed.scope.rolling(window_s)
        low, high = (
            {signal.name: values[row] for row, signal in enumerate(SIGNALS)}
            for values in (window.buckets.low, window.buckets.high)
        )
        yield RunFrame(feed.status(), events, window.t_s, low, high)
        if ended:
            return
        sleep(max(0.0, began_s + every_s - clock()))
