"""Usual ticks in a real ring: the same bytes as other ticks, and who asks is heard at once."""

import os

import numpy as np
import pytest

from hilctl.base.samples import Flag, Head
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.run.host import RingHost
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Stop
from tests.fakes import FakeClock, FakeDevice
from tests.unit.loop.test_composed import STALLS, plan

PAGE = (Field.SENT, Field.HEAD, Field.ENDED_AT, Field.EXCHANGING, Field.NEXT_SAMPLE)


class AskingDevice(FakeDevice):
    """Does something to the page at an exchange, as a supervisor would meanwhile."""

    def asks(self, page, at, what):
        self.page, self.at, self.what = page, at, what
        return self

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample == self.at:
            for field, number in self.what.items():
                self.page.put(field, number)
        super().exchange(first_sample, command, displacement_um, measured)


class Rig:
    """A loop on a ring in memory, whose supervisor is this process' parent and never silent."""

    def __init__(self, folder, made, *, slots=256, stalls=None, at=-1, what=None, **device):
        self.made = made
        size = made.compensator.state_size + 1
        self.ring = SampleRing.create(folder, slots=slots, block=made.block, state_size=size)
        self.ring.page.put(Field.SUPERVISOR_HEARTBEAT_NS, 1)
        self.host = RingHost(self.ring, FakeClock(stall_ns=stalls or {}), os.getppid(), 5.0)
        self.events = []
        self.host.record_event = lambda event: self.events.append(repr(event))
        self.device = AskingDevice(**device).asks(self.ring.page, at, what or {})
        self.loop = Loop(made, self.device, self.host)

    def run(self):
        self.loop.begin_at(0.0)
        return self.loop.run(1_000_000)

    def all(self):
        """Return outcome, events, page and all that stands in the ring, as plain values."""
        outcome, area = self.run(), self.ring.area
        page = [self.ring.page.get(field) for field in PAGE]
        rows = [each[: page[0]].tobytes() for each in (area.heads, area.states, area.flags)]
        return outcome, self.events, page, rows, area.columns[: page[0]].tobytes()


CASES = {
    "to its end": ({}, {}),
    "skipped ticks": ({}, {"stalls": STALLS}),
    "trip": ({"interlocks": InterlockContext(stroke_um=(-12.0, 12.0))}, {}),
    "trip after a skip": (
        {"interlocks": InterlockContext(stroke_um=(-40.0, 40.0), frozen_travel=0.1)},
        {"stalls": STALLS, "nan_at": 50},
    ),
    "invalid": ({"input_um": np.where(np.arange(84) == 43, np.nan, 1.0)}, {}),
    "limits": ({"limits": CommandLimits(-1.0, 1.0, 150.0, 0.0, 100.0)}, {}),
    "no answer": ({}, {"break_at": 40}),
    "no room": ({"keep_all": True}, {"slots": 3}),
    "no room, and on": ({}, {"slots": 3}),
    "stop": ({}, {"at": 42, "what": {Field.STOP: Stop.REQUEST}}),
    "silence": ({}, {"at": 42, "what": {Field.SUPERVISOR_HEARTBEAT_NS: -(10**10)}}),
    "tuned": ({}, {"at": 42, "what": {Field.TUNE_SAMPLES: 5, Field.TUNE_WANTED: 1}}),
}


@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("name", CASES)
def test_same_bytes_in_the_ring(monkeypatch, tmp_path, name, block):
    """Heads, states, columns, flags, the page's numbers and the events, with and without."""
    options, around = CASES[name]
    usual = Rig(tmp_path / "usual", plan(block=block, **options), **around).all()
    monkeypatch.setattr(RingHost, "direct", lambda _self: None)
    assert usual == Rig(tmp_path / "other", plan(block=block, **options), **around).all()


@pytest.fixture
def claims(monkeypatch):
    """The blocks that were claimed one by one: those of ticks that are not usual."""
    seen, claim = [], SampleRing.claim

    def noting(self, *, due=True):
        seen.append(self.page.get(Field.SENT))
        return claim(self, due=due)

    monkeypatch.setattr(SampleRing, "claim", noting)
    return seen


def test_only_the_ramp_is_claimed(tmp_path, claims):
    """All ticks of the waveform are usual ones."""
    rig = Rig(tmp_path / "ring", plan())
    assert rig.run().code == "completed"
    assert claims[0] == 84


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({Field.STOP: Stop.REQUEST}, "stop"),
        ({Field.SUPERVISOR_HEARTBEAT_NS: -(10**10)}, "silent for 5 s"),
    ],
)
def test_what_is_asked_holds_from_the_next_tick_on(tmp_path, claims, what, reason):
    """Asked during the exchange of sample 42, the ramp begins at 43."""
    rig = Rig(tmp_path / "ring", plan(), at=42, what=what)
    outcome = rig.run()
    assert outcome.code == "stopped"
    assert reason in outcome.reason
    assert claims[0] == 43
    assert rig.ring.area.flags[43, 0] & Flag.RAMP
    assert not rig.ring.area.flags[42, 0] & Flag.RAMP


def test_a_dead_supervisor_ends_the_run(tmp_path, monkeypatch, claims):
    """It is looked for in every tick, before anything is sent."""
    rig = Rig(tmp_path / "ring", plan())
    looks = []
    monkeypatch.setattr(
        os, "getppid", lambda: looks.append(0) or (rig.host._supervisor if len(looks) < 20 else 1)
    )
    outcome = rig.run()
    assert outcome.reason == "stopped because the supervisor died"
    assert claims[0] == 19


def test_a_block_on_its_way_can_be_seen_as_such(tmp_path):
    """Before the exchange the ring holds its commands, and says that they are under way."""
    seen = []

    class Looking(FakeDevice):
        def exchange(self, first_sample, command, displacement_um, measured):
            if first_sample == 20:
                batch = rig.ring.unanswered(20)
                numbers = [rig.ring.page.get(field) for field in PAGE]
                seen.append((batch.heads[0, Head.FIRST_SAMPLE], batch.columns[0, 2, 0], numbers))
                seen.append(float(command[0]))
            super().exchange(first_sample, command, displacement_um, measured)

    rig = Rig(tmp_path / "ring", plan())
    rig.loop = Loop(rig.made, Looking(), rig.host)
    rig.run()
    (first, sent, numbers), command = seen
    assert (first, sent) == (20, command)
    assert numbers == [21, 20, 21, 1, 20]


def test_heartbeat_of_a_usual_tick(tmp_path):
    """When it woke, which sample comes, and how many ticks were late."""
    rig = Rig(tmp_path / "ring", plan(n=30), stalls={5: 600_000}, break_at=20)
    rig.run()
    page = rig.ring.page
    assert page.get(Field.LATE_TICKS) == 1
    assert page.get(Field.NEXT_SAMPLE) == 20
    assert page.get(Field.LOOP_HEARTBEAT_NS) >= 1_000_000 + 20 * 1_000_000
