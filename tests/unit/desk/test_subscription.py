"""Frames for programs: at their pace, each event once, and a last one after the end."""

from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.events import Event
from hilctl.desk.envelope import Buckets
from hilctl.desk.scope import Window
from hilctl.desk.signals import SIGNALS
from hilctl.desk.subscription import frames_of
from tests.fakes import SteppingClock


@pytest.fixture
def feed():
    """A run that is over at its fourth look, with one event at each."""
    values = np.arange(3.0 * len(SIGNALS)).reshape(len(SIGNALS), 3)
    looked = []
    made = SimpleNamespace(ended=False, looked=looked, windows=[])

    def poll(now_s):
        looked.append(now_s)
        made.ended = len(looked) == 4

    def rolling(window_s):
        made.windows.append(window_s)
        return Window(np.array([-2.0, -1.0, 0.0]), Buckets(values, values + 1.0, values))

    made.poll, made.scope = poll, SimpleNamespace(rolling=rolling)
    made.status = lambda: {"t_s": looked[-1]}
    made.events_since = lambda seen: (
        [Event(k, "info", "mark", "") for k in range(seen, len(looked))],
        len(looked),
    )
    return made


def test_frames_come_at_their_pace_until_the_run_is_over(feed):
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
