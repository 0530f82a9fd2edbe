"""The loop's host: heartbeats out, stop words and tunings in, through the shared page."""

import math

import pytest

from hilctl.kernels import tick
from hilctl.loop.host import StraightLine, Tuning
from hilctl.run.host import RingHost
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase, Stop
from tests.fakes import FakeClock

SILENCE_S = 2.0


@pytest.fixture
def ring(tmp_path):
    return SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)


@pytest.fixture
def clock():
    return FakeClock(now=10_000_000_000)


@pytest.fixture
def host(ring, clock, monkeypatch):
    """A host whose supervisor is process 77 and shows life at once."""
    monkeypatch.setattr("os.getppid", lambda: 77)
    ring.page.put(Field.SUPERVISOR_HEARTBEAT_NS, clock.now)
    return RingHost(ring, clock, 77, SILENCE_S)


def test_a_heartbeat_shows_time_sample_and_late_ticks(host, ring, clock):
    assert host.heartbeat(50, 3) == ""
    page = ring.page
    assert page.get(Field.LOOP_HEARTBEAT_NS) == clock.now
    assert (page.get(Field.NEXT_SAMPLE), page.get(Field.LATE_TICKS)) == (50, 3)


def test_each_reason_to_end_is_said(host, ring, clock, monkeypatch):
    """A silent supervisor, one that died, and first of all a stop that was asked for."""
    clock.now += int(SILENCE_S * 1e9)
    assert host.heartbeat(0, 0) == ""
    clock.now += 1
    assert host.heartbeat(0, 0) == "stopped because the supervisor was silent for 2 s"
    monkeypatch.setattr("os.getppid", lambda: 1)
    assert host.heartbeat(0, 0) == "stopped because the supervisor died"
    ring.page.put(Field.STOP, Stop.CTRL_C)
    assert host.heartbeat(0, 0) == Stop.CTRL_C.reason


def test_a_tuning_is_taken_once(host, ring):
    """The same wish is not taken again; the next one is."""
    page = ring.page
    assert host.tuning() is None
    for number, gain in enumerate((0.5, 0.75), start=1):
        page.put_float(Field.TUNE_GAIN, gain)
        page.put_float(Field.TUNE_OFFSET, -1.0)
        page.put(Field.TUNE_SAMPLES, 40)
        page.put_float(Field.TUNE_INVERSE_SHARE, 0.25)
        page.put_float(Field.TUNE_LINE_SLOPE, 0.1)
        page.put_float(Field.TUNE_LINE_AT_ZERO, -2.0)
        page.put(Field.TUNE_WANTED, number)
        assert host.tuning() == Tuning(gain, -1.0, 40, 0, 0.25, StraightLine(0.1, -2.0))
        assert host.tuning() is None
        assert page.get(Field.TUNE_TAKEN) == number


def test_a_tuning_waits_for_its_sample(host, ring):
    """It was worked out from there on; where a tick was skipped it begins at the next one."""
    page = ring.page
    page.put_float(Field.TUNE_GAIN, 0.5)
    page.put_float(Field.TUNE_INVERSE_SHARE, 1.0)
    page.put(Field.TUNE_SAMPLES, 40)
    page.put(Field.TUNE_BEGINS_AT, 60)
    page.put(Field.TUNE_WANTED, 1)
    host.heartbeat(59, 0)
    assert host.tuning() is None
    assert page.get(Field.TUNE_TAKEN) == 0
    host.heartbeat(61, 0)
    assert host.tuning() == Tuning(0.5, 0.0, 40, 60)
    assert page.get(Field.TUNE_TAKEN) == 1


def test_closing_is_shown_before_the_device_takes_its_time(host, ring, clock):
    host.closing()
    assert ring.page.get(Field.PHASE) == Phase.CLOSING
    assert ring.page.get(Field.LOOP_HEARTBEAT_NS) == clock.now


def test_a_supervisor_may_be_silent_for_ever(ring, clock):
    """Where the experiment says that the run goes on without it."""
    direct = RingHost(ring, clock, 77, math.inf).direct()
    assert direct.numbers[tick.SILENCE_NS] > 100 * 365 * 86_400 * 10**9
