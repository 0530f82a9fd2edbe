"""Keys, screens and requests of who looks on a run; nothing here waits."""

from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import Event
from hilctl.cli import watcher as module
from hilctl.cli.watcher import Watcher
from tests.fakes import SteppingClock


class FakeScreen:
    """Keys by the frame that they come after; a frame passes the time that it is waited for."""

    coloured = False

    def __init__(self, clock, frames, *, interactive=True):
        self._clock, self._frames, self.interactive = clock, iter(frames), interactive
        self.shown, self.said = [], []

    def size(self):
        return 80, 24

    def show(self, lines):
        self.shown.append(lines)

    def say(self, text):
        self.said.append(text)

    def keys(self, wait_s):
        self._clock.now += wait_s
        return next(self._frames, "q")


@pytest.fixture
def sent(monkeypatch):
    """What the run was asked."""
    asked = []

    def set_run(folder, **wanted):
        asked.append(wanted)
        if wanted.get("gain", 0.0) > 1.0:
            raise InputError("set: too much")

    def mark_run(folder, text):
        asked.append(text)
        return {"sample": 700}

    monkeypatch.setattr(module, "set_run", set_run)
    monkeypatch.setattr(module, "mark_run", mark_run)
    monkeypatch.setattr(module, "request_stop", lambda folder: asked.append("stop") or True)
    # What a screen looks like is the business of test_watch_view.py.
    monkeypatch.setattr(module, "screen", lambda feed, mode, message: [mode, message])
    monkeypatch.setattr(module, "line", lambda feed: "a line")
    return asked


def feed_of(inverse="in", gain=1.0, ends_after=10**9):
    left = iter(range(ends_after))
    made = SimpleNamespace(folder="folder", inverse=inverse, ended=False)
    made.description = SimpleNamespace(sample_rate_hz=1000.0)
    made.status = lambda: {"gain": gain}

    def poll(now_s):
        made.ended = next(left, None) is None

    made.poll = poll
    return made


def at_once(ask, answer):
    try:
        answer(ask())
    except InputError as error:
        answer(f"refused: {error}")


def watched(frames, feed=None, begin=at_once, **options):
    clock = SteppingClock()
    shown = FakeScreen(clock, frames, **options)
    Watcher(feed or feed_of(), shown, clock, begin).run()
    return shown


@pytest.mark.parametrize(
    ("key", "feed", "wanted"),
    [
        ("i", feed_of("in"), {"inverse": "out", "over_s": 0.5}),
        ("i", feed_of("out"), {"inverse": "in", "over_s": 0.5}),
        ("+", feed_of(gain=0.7), {"gain": 0.8, "over_s": 0.5}),
        ("-", feed_of(gain=0.7), {"gain": 0.6, "over_s": 0.5}),
    ],
)
def test_a_key_is_one_request(sent, key, feed, wanted):
    shown = watched([key, ""], feed)
    assert sent == [wanted]
    assert shown.shown[-1][1].endswith("over 0.5 s")


def test_a_refusal_stands_on_the_screen(sent):
    shown = watched(["+", ""], feed_of(gain=1.0))
    assert shown.shown[-1][1] == "refused: set: too much"
    shown = watched(["i", ""], feed_of(inverse=None))
    assert "no compensator" in shown.shown[-1][1]
    assert len(sent) == 1


def test_a_stop_goes_by_itself_while_a_change_is_on_its_way(sent):
    """A second change waits for the answer to the first."""
    shown = watched(["i", "+", "s", ""], begin=lambda ask, answer: None)
    assert sent == ["stop"]
    messages = [message for _, message in shown.shown]
    assert messages[1:4] == [
        "inverse out: asked for",
        "one change at a time: wait for the answer",
        "stop requested",
    ]


def test_a_stop_that_is_refused_is_said(sent, monkeypatch):
    def refuse(folder):
        raise RunError("can't be stopped: no right")

    monkeypatch.setattr(module, "request_stop", refuse)
    assert watched(["s", ""]).shown[-1][1] == "can't be stopped: no right"


def test_a_mark_is_typed_and_its_letters_are_no_keys(sent):
    shown = watched(["m", "taps", "\x7f", "\x07", "\r", ""])
    assert sent == ["tap"]
    assert shown.shown[2][1].startswith("mark: taps_")
    assert shown.shown[-1][1] == "marked sample 700"
    watched(["m", "qsi", "\x1b", ""])
    watched(["m", "  \r", ""])
    assert sent == ["tap"]


def test_the_scope_is_looked_at_in_other_ways(sent):
    modes = [mode for mode, _ in watched(["t", "]", "["]).shown]
    assert [mode.triggered for mode in modes] == [True, False, False, False]
    assert modes[1].window_s == modes[3].window_s < modes[2].window_s


def test_it_ends_with_the_run_and_unknown_keys_do_nothing(sent):
    assert len(watched(["z"] * 9, feed_of(ends_after=3)).shown) == 4
    assert sent == []


def test_without_a_terminal_there_are_lines(sent):
    """One a second, and each event once."""
    feed = feed_of(ends_after=30)
    event = Event(500, "info", "mark", "tapped")
    feed.events_since = lambda seen: ([event][seen:], 1)
    shown = watched([""] * 30, feed, interactive=False)
    assert shown.shown == []
    assert shown.said[0] == "0.500 s  mark: tapped"
    assert shown.said[1:] == ["a line"] * 4


def test_a_request_of_a_thread_comes_back(sent):
    """With its answer, or why not."""
    found = []
    for ask in (lambda: "done", lambda: module.set_run("folder", gain=2.0)):
        answered = module.threading.Event()
        module.begin_request(ask, lambda text, e=answered: (found.append(text), e.set()))
        assert answered.wait(10.0)
    assert found == ["done", "refused: set: too much"]
