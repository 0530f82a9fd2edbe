"""Connections to an active run."""

import math
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from hilctl import api
from hilctl.api import connection
from hilctl.base.errors import InputError, RunError

HEAVY = ("numba", "scipy", "matplotlib")


@pytest.fixture
def run(monkeypatch):
    """A connection whose requests are returned."""
    card = SimpleNamespace(name="sine-7", recording="a.mcap")
    monkeypatch.setattr(connection, "find_run", lambda name: SimpleNamespace(card=card, asked=name))
    for name in ("status_of", "mark_run", "set_run"):
        monkeypatch.setattr(connection, name, lambda folder, *given, **named: (*given, named))
    return api.connect("sine")


def test_a_run_that_does_not_stop_is_an_error(run, monkeypatch):
    stopped = {"ended": False, "error": ""}
    monkeypatch.setattr(connection, "stop_runs", lambda chosen, wait_s: [stopped])
    with pytest.raises(RunError, match="sine-7"):
        run.stop(2.0)
    stopped["ended"] = True
    run.stop()


def test_the_import_is_light():
    code = f"import sys, hilctl.api; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_frames_are_those_of_the_run(run, monkeypatch):
    monkeypatch.setattr("hilctl.live.run_reader.RunReader", lambda folder, axis: folder.card.name)
    monkeypatch.setattr("hilctl.live.run_reader.frames_of", lambda *given: iter([given]))
    ((feed, every_s, window_s, clock, sleep),) = run.frames(0.2, 2.0)
    assert (feed, every_s, window_s) == ("sine-7", 0.2, 2.0)
    assert (clock, sleep) == (time.monotonic, time.sleep)


@pytest.mark.parametrize("times", [{"window_s": 0.0}, {"window_s": math.nan}, {"every_s": -1.0}])
def test_invalid_times_of_frames_are_refused(run, times):
    with pytest.raises(InputError, match=next(iter(times))):
        run.frames(**times)
