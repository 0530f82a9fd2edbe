"""Encoding of frames."""

import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.events import Event
from hilctl.base.segments import Segment
from hilctl.live.frame_codec import frame_of, frames_of, nearest_window_s
from hilctl.live.scope import ROW, SIGNALS, Buckets, Scope, ScopeWindow
from tests.fakes import SteppingClock
from tests.unit.live.conftest import traces


@pytest.fixture
def scope():
    made = Scope(1000.0, [Segment("sine", 0, 9000, 0, 9000, 50.0)], "reference")
    made.add(traces(0, **dict.fromkeys(ROW.keys() - {"measured"}, np.arange(600.0))))
    return made


def decoded(frame):
    (size,) = struct.unpack_from("<I", frame)
    header = json.loads(frame[4 : 4 + size])
    values = np.frombuffer(frame, "<f4", offset=4 + size)
    n, rows = header["n"], header["signals"] * header["n"]
    low, high = values[n : n + rows], values[n + rows : n + 2 * rows]
    loops = values[n + 2 * rows :].reshape(2, header["loop"])
    return header, values[:n], low.reshape(-1, n), high.reshape(-1, n), loops


def test_a_frame_holds_the_window_and_the_loops(scope):
    frame = frame_of(scope, "cycle", 2.0)
    header, t_s, low, high, loops = decoded(frame)
    assert header == {"mode": "cycle", "n": 100, "signals": 6, "loop": 300, "cycle": 50}
    assert t_s == pytest.approx(np.arange(100) / 1000.0)
    assert low[ROW["error"]].tolist() == high[ROW["error"]].tolist() == list(range(500, 600))
    assert np.isnan(low[ROW["measured"]]).all()
    assert loops[0].tolist() == list(range(300, 600))
    assert len(frame) % 4 == 0


def test_frame_without_a_cycle_rolls(scope):
    header, t_s, *_ = decoded(frame_of(scope, "roll", 0.1))
    assert (header["mode"], t_s[-1], t_s.size) == ("roll", 0.0, 100)
    empty = Scope(1000.0, [], "reference")
    assert decoded(frame_of(empty, "cycle", 0.1))[0]["mode"] == "roll"


def test_nearest_window():
    assert [nearest_window_s(wanted_s) for wanted_s in (2, 1e9, 1e-9, 3)] == [2, 600, 0.02, 2]


@pytest.fixture
def feed():
    """A run that ends at its fourth poll, with one event per poll."""
    values = np.arange(3.0 * len(SIGNALS)).reshape(len(SIGNALS), 3)
    looked = []
    made = SimpleNamespace(ended=False, looked=looked, windows=[])

    def poll(now_s):
        looked.append(now_s)
        made.ended = len(looked) == 4

    def rolling(window_s):
        made.windows.append(window_s)
        return ScopeWindow(np.array([-2.0, -1.0, 0.0]), Buckets(values, values + 1.0, values))

    made.poll, made.scope = poll, SimpleNamespace(rolling=rolling)

    def events_since(seen):
        return [Event(k, "info", "mark", "") for k in range(seen, len(looked))], len(looked)

    made.status, made.events_since = lambda: {"t_s": looked[-1]}, events_since
    return made


def test_frames_keep_their_interval_until_the_run_ends(feed):
    clock, slept = SteppingClock(), []

    def sleep(seconds):
        slept.append(seconds)
        clock.now += seconds

    frames = []
    for frame in frames_of(feed, 0.25, 0.4, clock, sleep):
        frames.append(frame)
        clock.now += 0.1 if len(frames) != 2 else 1.0
    assert feed.looked == pytest.approx([0.0, 0.25, 1.25, 1.5])
    assert slept == pytest.approx([0.15, 0.0, 0.15])
    assert [[event.sample for event in frame.events] for frame in frames] == [[0], [1], [2], [3]]
    assert {*feed.windows} == {0.5}
    assert frames[0].low["displacement"].tolist() == [3.0, 4.0, 5.0]
    assert frames[0].high["displacement"].tolist() == [4.0, 5.0, 6.0]
