"""Whoever looks on a run: shown the newest, waited for by nobody."""

import threading

from hilctl.run import progress as module
from hilctl.run.progress import ProgressThread


def test_the_last_is_shown_and_nothing_where_there_is_nothing_new(monkeypatch):
    monkeypatch.setattr(module, "_EVERY_S", 60.0)
    for current, shown in ((7, [7]), (None, [])):
        seen = []
        thread = ProgressThread(lambda current=current: current, seen.append, seen.append)
        thread.start()
        thread.end()
        assert seen == shown


def test_an_error_is_said_once(monkeypatch):
    monkeypatch.setattr(module, "_EVERY_S", 0.0)
    errors = []
    thread = ProgressThread(lambda: 1, lambda progress: [][progress], errors.append)
    thread.start()
    thread._thread.join(30.0)
    thread.end()
    assert errors == ["progress is not shown any more: IndexError: list index out of range"]


def test_a_terminal_that_stands_still_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(module, "_EVERY_S", 0.0)
    monkeypatch.setattr(module, "_LAST_S", 0.0)
    entered, released = threading.Event(), threading.Event()

    def show(progress):
        entered.set()
        released.wait(30.0)

    thread = ProgressThread(lambda: 1, show, lambda text: None)
    thread.start()
    assert entered.wait(30.0)
    thread.end()
    assert thread._thread.is_alive()
    released.set()
    thread._thread.join(30.0)
