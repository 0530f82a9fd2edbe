"""Frames for a page (a JSON header and float32 values) and for programs.

uint32 little endian   size of the JSON in bytes, with spaces up to a multiple of 4
JSON                   ``mode``, ``n`` buckets, number of ``signals``, ``loop`` points of the loops,
                       ``cycle`` points per cycle
float32 little endian  t_s[n], low[signals, n], high[signals, n], input[loop], output[loop]
"""

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from hilctl.base.events import Event
from hilctl.base.types import F64
from hilctl.live.run_reader import RunReader
from hilctl.live.scope import SIGNALS, WINDOWS_S, Scope

ScopeMode: TypeAlias = Literal["roll", "cycle"]


def nearest_window_s(wanted_s: float) -> float:
    """Return the value of :data:`hilctl.live.scope.WINDOWS_S` with the nearest ratio."""
    return min(WINDOWS_S, key=lambda each: max(each / wanted_s, wanted_s / each))


def frame_of(scope: Scope, mode: ScopeMode, window_s: float) -> bytes:
    """Return the current frame of a page; without a cycle, mode ``cycle`` rolls.

    The length of a rolling window is one of :data:`hilctl.live.scope.WINDOWS_S`.
    """
    cycles = scope.triggered() if mode == "cycle" else None
    window, loops = cycles or scope.rolling(window_s), scope.loops()
    facts = {
        "mode": "cycle" if cycles else "roll",
        "n": window.t_s.size,
        "signals": len(SIGNALS),
        "loop": loops.shape[1],
        "cycle": scope.points_a_cycle(),
    }
    header = json.dumps(facts).encode()
    header += b" " * (-len(header) % 4)
    parts = (window.t_s, window.buckets.low, window.buckets.high, loops)
    values = np.concatenate([np.ravel(part) for part in parts]).astype("<f4")
    return struct.pack("<I", len(header)) + header + values.tobytes()


@dataclass(frozen=True, slots=True)
class RunFrame:
    """State of a run at one time.

    Attributes:
        status: Metrics, limits, lateness; see :meth:`RunReader.status`.
        events: Events since the previous frame.
        t_s: float64[n], start of each bucket of samples; 0 for the newest.
        low: Minimum of each bucket by signal, float64[n]; NaN if there is no value.
        high: Maximum of each bucket by signal.
    """

    status: dict[str, Any]
    events: list[Event]
    t_s: F64
    low: dict[str, F64]
    high: dict[str, F64]


def frames_of(
    feed: RunReader,
    every_s: float,
    window_s: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[RunFrame]:
    """Yield frames of a run until it ends; the last follows its end.

    A late frame delays the following ones. The available window that is nearest to ``window_s`` is
    used. The clock is monotonic time in s.
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
