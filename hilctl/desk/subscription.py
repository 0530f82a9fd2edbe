"""Frames of a live run for programs: its newest signals, figures, and events as they come."""

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
        status: Where it stands: figures, limits, lateness; see :meth:`RunFeed.status`.
        events: Those since the frame before.
        t_s: float64[n], beginning of each bucket of samples, up to 0 for the newest.
        low: Lowest value in each bucket by signal, float64[n]; NaN where there is none.
        high: Highest value, likewise: no spike is lost.
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
    """Give frames of a run until it is over, the last of them after its end.

    Args:
        feed: The run.
        every_s: Time from one frame to the next; one that is taken late does not hurry the next.
        window_s: Time that each shows; the nearest that is kept.
        clock: Monotonic time in s.
        sleep: Lets that many s pass.
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
