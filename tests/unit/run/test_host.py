"""The loop's host: heartbeats out, stop words and tunings in, through the shared page."""

import math
import os

import numpy as np
import pytest

from hilctl.base.samples import Flag, Head
from hilctl.loop.compensator import Compensator
from hilctl.loop.host import StraightLine, Tuning
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import LateRules
from hilctl.loop.plan import Plan
from hilctl.run import ring as ring_module
from hilctl.run.host import RingHost
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase, Stop
from tests.fakes import FakeClock, FakeDevice
from tests.published import terfenol_rdpi

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


def test_a_supervisor_may_be_silent_for_ever(ring, clock, monkeypatch):
    """Where the experiment says that the run goes on without it."""
    monkeypatch.setattr("os.getppid", lambda: 77)
    assert RingHost(ring, clock, 77, math.inf).heartbeat(0, 0) == ""


class AskingDevice(FakeDevice):
    """Calls a function in the exchange of one sample, as a supervisor would act meanwhile."""

    def __init__(self, at, act):
        super().__init__()
        self.at, self.act = at, act

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample == self.at:
            self.act(float(command[0]))
        super().exchange(first_sample, command, displacement_um, measured)


class Rig:
    """A loop on a ring, whose supervisor is this process' parent; it goes round several times."""

    SLOTS = 16
    SAMPLES = 84

    def __init__(self, folder, *, at=-1, act=lambda command: None, block=1, stalls=None):
        compensator = Compensator(terfenol_rdpi(), 1000.0)
        compensator.warm_up()
        reference = 14.0 * np.sin(2 * np.pi * 25.0 * np.arange(self.SAMPLES) / 1000.0)
        plan = Plan(
            reference=reference,
            input_um=reference,
            block=block,
            latency_blocks=0,
            sample_rate_hz=1000.0,
            compensator=compensator,
            limits=CommandLimits(-5.0, 5.0, 2000.0, 0.0, 100.0),
            interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
            late_rules=LateRules(late_after_ns=5e5),
        )
        size = compensator.state_size + 1
        self.ring = SampleRing.create(folder, slots=self.SLOTS, block=block, state_size=size)
        self.ring.page.put(Field.SUPERVISOR_HEARTBEAT_NS, 1)
        self.host = RingHost(self.ring, FakeClock(stall_ns=stalls or {}), os.getppid(), 5.0)
        self.batches, self.answered = [], self.host.answered
        self.host.answered = self.take
        self.loop = Loop(plan, AskingDevice(at, act), self.host)

    def take(self, block):
        """Record each block as it comes, and give its slot back."""
        done = self.answered(block)
        self.batches += [copied(batch) for batch in self.ring.batches()]
        self.ring.release()
        return done

    def run(self):
        self.loop.begin_at(0.0)
        return self.loop.run(1_000_000)

    def flags(self, number):
        return self.batches[number].flags[0, 0]


def copied(batch):
    return batch.rows(np.arange(batch.heads.shape[0]))


@pytest.mark.parametrize("block", [1, 7])
def test_a_slot_that_is_used_again_has_nothing_of_its_last_block(tmp_path, monkeypatch, block):
    """The same bytes as with a block made anew for each tick."""

    def recorded(folder):
        rig = Rig(folder, block=block, stalls={9: 2_500_000})
        outcome = rig.run()
        arrays = [[b.heads, b.states, b.columns, b.flags] for b in rig.batches]
        return outcome, [[each.tobytes() for each in batch] for batch in arrays]

    reused = recorded(tmp_path / "reused")
    monkeypatch.setattr(ring_module, "_MOST_BLOCKS", 0)
    assert reused == recorded(tmp_path / "anew")
    assert reused[0].code == "completed"


@pytest.mark.parametrize(
    ("field", "number", "reason"),
    [
        (Field.STOP, Stop.REQUEST, Stop.REQUEST.reason),
        (
            Field.SUPERVISOR_HEARTBEAT_NS,
            -(10**10),
            "stopped because the supervisor was silent for 5 s",
        ),
    ],
)
def test_what_is_asked_holds_from_the_next_tick_on(tmp_path, field, number, reason):
    """Asked during the exchange of sample 42, the ramp begins at 43."""
    rig = Rig(tmp_path / "ring", at=42, act=lambda _: rig.ring.page.put(field, number))
    outcome = rig.run()
    assert (outcome.code, outcome.reason) == ("stopped", reason)
    assert rig.flags(43) & Flag.RAMP
    assert not rig.flags(42) & Flag.RAMP


def test_a_block_on_its_way_can_be_seen_as_such(tmp_path):
    """Before the exchange the ring holds its commands, and says that they are under way."""
    seen = []

    def look(command):
        batch, page = rig.ring.unanswered(20), rig.ring.page
        sent = batch.heads[0, Head.FIRST_SAMPLE], batch.columns[0, 2, 0]
        fields = (Field.SENT, Field.HEAD, Field.ENDED_AT, Field.EXCHANGING, Field.NEXT_SAMPLE)
        seen.append((*sent, [page.get(field) for field in fields]))
        assert sent[1] == command

    rig = Rig(tmp_path / "ring", at=20, act=look)
    rig.run()
    assert seen[0][0] == 20
    assert seen[0][2] == [21, 20, 21, 1, 20]


def test_a_tick_shows_how_many_were_late(tmp_path):
    page = []
    fields = (Field.LATE_TICKS, Field.NEXT_SAMPLE, Field.LOOP_HEARTBEAT_NS)
    rig = Rig(
        tmp_path / "ring",
        at=20,
        act=lambda _: page.extend(rig.ring.page.get(field) for field in fields),
        stalls={5: 600_000},
    )
    rig.run()
    assert page[:2] == [1, 20]
    assert page[2] >= 21_000_000
