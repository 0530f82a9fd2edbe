"""A live run as text: what fits into a screen, and what is said of the run."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.events import Event
from hilctl.cli.watch_view import KEYS, WatchMode, event_line, line, next_window_s, screen
from hilctl.desk.envelope import Buckets
from hilctl.desk.scope import WINDOWS_S, Window
from hilctl.desk.signals import SIGNALS

PLAIN = WatchMode(coloured=False)


def window():
    t_s = np.linspace(0.0, 0.02, 300)
    values = np.tile(40.0 * np.sin(628.0 * t_s), (len(SIGNALS), 1))
    return Window(t_s, Buckets(values, values, values))


@pytest.fixture
def feed():
    """A run of which all is known."""
    status = {
        "run": "demo-7",
        "state": "running",
        "t_s": 12.34,
        "total_s": 30.0,
        "inverse": "out",
        "gain": 0.5,
        "offset": -2.0,
        "figures": {"peak_hysteresis_percent": 29.6, "rms_error_percent": None},
        "lateness_us": {"p50": 3.0, "p99": 21.0, "max": 40.0},
        "late_ticks": 9,
        "gauges": [{"name": "command", "used": 0.84}, {"name": "ring", "used": 0.25}],
        "events": [{"t_s": 1.0 * k, "code": "mark", "text": f"tap {k}"} for k in range(5)],
    }
    sine = window().buckets.low[:2]
    scope = SimpleNamespace(triggered=window, rolling=lambda s: window(), loops=lambda: sine)
    description = SimpleNamespace(command_unit="A", sample_rate_hz=1000.0)
    return SimpleNamespace(
        status=lambda: status, scope=scope, loop_input="reference", description=description
    )


@pytest.mark.parametrize("size", [(80, 24), (60, 24), (120, 50), (40, 14), (39, 24), (80, 5)])
@pytest.mark.parametrize("coloured", [True, False])
def test_a_screen_fits(feed, size, coloured):
    """Whatever its size; where it is too small for curves, the words are left."""
    lines = screen(feed, WatchMode(*size, coloured=coloured), "x" * 200)
    width, height = size
    assert len(lines) <= height
    shown = [re.sub("\x1b\\[[0-9;]*m", "", each) for each in lines]
    assert max(map(len, shown)) <= width
    assert shown[0].startswith("demo-7  running  12.3/30.0 s")
    drawn = any(0x2800 < ord(each) < 0x2900 for each in "".join(shown))
    assert drawn == (width >= 40 and height >= 14)


def test_figures_events_and_limits_are_said(feed):
    lines = screen(feed, PLAIN, "inverse out, over 0.5 s")
    text = "\n".join(lines)
    for said in (
        "inverse out  gain 0.5  offset -2",
        "hyst. 29.60 %",
        "late ticks 9  p99 21 us  latest 40 us",
        "limits: command 84 %",
        "inverse out, over 0.5 s",
        KEYS,
    ):
        assert said in text
    assert "tap 1" not in text
    assert [line for line in lines if "tap" in line] == [
        f"{k:9.3f} s  mark: tap {k}" for k in (2, 3, 4)
    ]
    assert "rms" not in text


def test_a_waveform_without_a_cycle_rolls(feed):
    feed.scope.triggered = lambda: None
    assert "last 0.1 s" in "\n".join(screen(feed, PLAIN, ""))
    rolling = replace(PLAIN, triggered=False, window_s=2.0)
    assert "last 2 s" in "\n".join(screen(feed, rolling, ""))


def test_what_steers_a_terminal_is_written_out(feed):
    feed.status()["events"][-1]["text"] = "tap \x1b[2J"
    feed.status()["run"] = "demo\x07"
    text = "\n".join(screen(feed, PLAIN, ""))
    assert "\x1b" not in text
    assert "\x07" not in text


def test_a_line_says_where_the_run_stands(feed):
    said = line(feed)
    assert said.startswith("12.3 s  running  hyst. 29.60 %")
    assert "\n" not in said
    event = Event(1500, "info", "mark", "tapped \x1b[2J")
    assert event_line(event, 1000.0) == "1.500 s  mark: tapped \\x1b[2J"


def test_windows_end_at_the_shortest_and_the_longest():
    assert next_window_s(WINDOWS_S[0], -1) == WINDOWS_S[0]
    assert next_window_s(WINDOWS_S[0], 1) == WINDOWS_S[1]
    assert next_window_s(WINDOWS_S[-1], 1) == WINDOWS_S[-1]
