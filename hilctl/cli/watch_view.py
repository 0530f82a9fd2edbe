"""A live run as text: a screen of scope, loop, figures and events, or a line now and then."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilctl.base.printable import printable
from hilctl.cli.braille import BrailleCurve, envelope, plot
from hilctl.desk.feed import RunFeed
from hilctl.desk.scope import WINDOWS_S, Window
from hilctl.desk.signals import ROW

KEYS = "s stop  i inverse  +- gain  m mark  t trigger  [] time  q leave"
_SMALLEST = (40, 14)
_TEXT_LINES = 9  # head, figures, limits, events, message, keys
_EVENTS = 3
_FIGURES = (
    ("hyst.", "peak_hysteresis_percent", "%"),
    ("peak", "peak_error_percent", "%"),
    ("rms", "rms_error_percent", "%"),
    ("stroke", "peak_to_peak_um", "um"),
    ("floor", "noise_floor_percent", "%"),
)


@dataclass(frozen=True, slots=True)
class WatchMode:
    """How a screen is to look.

    Attributes:
        width: Columns.
        height: Lines.
        coloured: Whether it may have colours.
        triggered: Whether the scope shows the newest cycles; else it rolls.
        window_s: Length of the rolling window, one of :data:`hilctl.desk.scope.WINDOWS_S`.
    """

    width: int = 80
    height: int = 24
    coloured: bool = True
    triggered: bool = True
    window_s: float = WINDOWS_S[1]


def screen(feed: RunFeed, mode: WatchMode, message: str) -> list[str]:
    """Return a screen: at most ``mode.height`` lines of at most ``mode.width`` columns.

    Args:
        feed: The run.
        mode: How it is to look.
        message: What was answered to the last key, or what is being typed.
    """
    status = feed.status()
    width, height = mode.width, mode.height
    drawn = []
    if width >= _SMALLEST[0] and height >= _SMALLEST[1]:
        drawn = _plots(feed, mode, height - _TEXT_LINES)
    head = [_cut(text, width) for text in (_head(status), _figures(status), _timing(status))]
    events = [_cut(_event(each), width) for each in status["events"][-_EVENTS:]]
    events += [""] * (_EVENTS - len(events))
    foot = [_cut(text, width) for text in (_limits(status), *events, message, KEYS)]
    return [head[0], *drawn, *head[1:], *foot][:height]


def line(feed: RunFeed) -> str:
    """Return where a run stands, in a line, for where there is no terminal."""
    status = feed.status()
    return "  ".join(
        part
        for part in (f"{status['t_s']:.1f} s", status["state"], _figures(status), _timing(status))
        if part
    )


def event_line(event: Any, rate_hz: float) -> str:
    """Return an event of a run, in a line."""
    return f"{event.sample / rate_hz:.3f} s  {event.code}: {printable(event.text)}"


def _plots(feed: RunFeed, mode: WatchMode, height: int) -> list[str]:
    # A character is twice as high as it is wide, and an axis takes some: so the loop is a square.
    loop_width = min(int(0.42 * mode.width), 2 * height + 4)
    scope_width = mode.width - loop_width
    window = feed.scope.triggered() if mode.triggered else None
    title = "newest cycles, ms"
    if window is None:
        window = feed.scope.rolling(mode.window_s)
        title = f"last {mode.window_s:g} s, ms"
    unit = "um" if feed.loop_input == "reference" else feed.description.command_unit
    scope = plot(_scope(window, scope_width), scope_width, height, title, coloured=mode.coloured)
    across, along = feed.scope.loops()
    curve = [BrailleCurve(across, along, "orange")]
    name = f"against {feed.loop_input}, {unit}"
    loop = plot(curve, loop_width, height, name, coloured=mode.coloured)
    return [left + right for left, right in zip(scope, loop, strict=True)]


def _scope(window: Window, width: int) -> list[BrailleCurve]:
    curves = []
    for name, colour in (("reference", "blue"), ("displacement", "orange")):
        low, high = window.buckets.low[ROW[name]], window.buckets.high[ROW[name]]
        if np.isfinite(low).any():
            x, y = envelope(window.t_s * 1e3, low, high, 2 * width)
            curves.append(BrailleCurve(x, y, colour))
    return curves


def _head(status: dict[str, Any]) -> str:
    inverse = f"  inverse {status['inverse']}" if status["inverse"] else ""
    return (
        f"{printable(status['run'])}  {status['state']}  {status['t_s']:.1f}/"
        f"{status['total_s']:.1f} s{inverse}  gain {status['gain']:g}  offset {status['offset']:g}"
    )


def _figures(status: dict[str, Any]) -> str:
    known = status["figures"]
    shown = [
        f"{label} {known[name]:5.2f} {unit}"
        for label, name, unit in _FIGURES
        if known.get(name) is not None
    ]
    return "  ".join(shown)


def _timing(status: dict[str, Any]) -> str:
    late = status["lateness_us"]
    wakes = f"  p99 {late['p99']:.0f} us  latest {late['max']:.0f} us" if late else ""
    return f"late ticks {status['late_ticks']}{wakes}"


def _limits(status: dict[str, Any]) -> str:
    used = (f"{each['name']} {100.0 * each['used']:.0f} %" for each in status["gauges"])
    return "limits: " + "  ".join(used)


def _event(event: dict[str, Any]) -> str:
    return f"{event['t_s']:9.3f} s  {event['code']}: {printable(event['text'])}"


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: max(0, width - 3)] + "..."


def next_window_s(window_s: float, by: int, windows: Sequence[float] = WINDOWS_S) -> float:
    """Return the window that is so many longer, within those there are."""
    return windows[min(len(windows) - 1, max(0, windows.index(window_s) + by))]
