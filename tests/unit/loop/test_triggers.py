"""Marks, pulses at them, and the start by a digital input."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.events import TRIGGERED
from hilctl.base.samples import BlockHeader, Flag
from hilctl.base.segments import Segment
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.triggers import Triggers, marks_of
from tests.fakes import FakeClock, FakeDevice, FakeHost, loop_plan

MS = 1_000_000
START_NS = 5 * MS
SEGMENTS = (
    Segment("sine", 0, 25, 0, 25, period=10.0),
    Segment("hold", 25, 40, 25, 40),
    Segment("sine", 40, 50, 40, 50, period=2.5),
)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("run", [0]),
        ("segment", [0, 25, 40]),
        ("cycle", [0, 10, 20, 40, 43, 45, 48]),
        (None, []),
    ],
)
def test_marks(kind, expected):
    assert marks_of(kind, SEGMENTS).tolist() == expected


def test_a_cycle_without_a_sample_of_its_segment_has_no_mark():
    segments = [Segment("sine", 0, 25, 0, 25, period=12.2), Segment("hold", 25, 40, 25, 40)]
    assert marks_of("cycle", segments).tolist() == [0, 13]


def test_cycles_do_not_drift():
    period, cycles = 1000.0 / 3.0, 3000
    marks = marks_of("cycle", [Segment("sine", 0, 1_000_000, 0, 1_000_000, period=period)])
    assert marks.size == cycles
    assert np.array_equal(marks[::3], np.arange(0, 1_000_000, 1000))


@dataclass
class DigitalDouble(FakeDevice):
    """A device that records its pulses by the number of commands before, and reads given levels."""

    high_from: int = 0  # reading
    reads: int = 0
    pulses: list = field(default_factory=list)

    def set_digital(self, high):
        self.pulses.append((len(self.commands) - 1, high))

    def read_digital(self):
        self.reads += 1
        return self.reads > self.high_from


class Rig:
    def __init__(self, samples=40, clock=None, stop=lambda: "", device=None, **triggers):
        self.device = device or DigitalDouble()
        self.host = FakeHost(clock or FakeClock(), stop=stop)
        values = np.linspace(0.0, 1.0, samples)
        triggers = {"marks": np.empty(0, np.int64), **triggers}
        plan = loop_plan(
            reference=values,
            input_um=values,
            block=1,
            latency_blocks=0,
            sample_rate_hz=1000.0,
            compensator=Compensator(None, 1000.0),
            limits=CommandLimits(low=-5.0, high=5.0, slew_per_s=1e4, safe=0.0, ramp_per_s=100.0),
            interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
            triggers=Triggers(**triggers),
        )
        self.loop = Loop(plan, [self.device], self.host)

    def run(self):
        self.loop.begin_at([self.device.output()])
        return self.loop.run(START_NS)

    @property
    def flagged(self):
        firsts = [head[BlockHeader.FIRST_SAMPLE] for head in self.host.heads]
        pairs = zip(firsts, self.host.flags, strict=True)
        return [first for first, flags in pairs if flags[0] & Flag.TRIGGER]

    @property
    def codes(self):
        return [event.code for event in self.host.events]


def pulses_at(marks):
    return [(sample + k, high) for sample in marks for k, high in enumerate((True, False))]


def test_a_pulse_of_one_sample_at_each_mark():
    rig = Rig(marks=np.array([0, 10, 12, 39]))
    rig.run()
    assert rig.device.pulses == pulses_at([0, 10, 12, 39])
    assert rig.flagged == [0, 10, 12, 39]


def test_marks_follow_the_initial_ramp():
    rig = Rig(marks=np.array([0]), device=DigitalDouble(output_at_open=1.0))
    ramp = rig.loop.begin_at([1.0])
    rig.loop.run(START_NS)
    assert ramp > 1
    assert rig.flagged == [ramp]


def test_mark_in_skipped_ticks_is_delayed():
    rig = Rig(marks=np.array([10, 14]), clock=FakeClock(stall_ns={9: 4 * MS}))
    rig.run()
    assert rig.flagged == [13, 15]  # low in between
    assert len(rig.device.pulses) == 4


def test_no_pulse_on_the_safe_ramp():
    rig = Rig(marks=np.array([0, 22, 24]), stop=lambda: "asked" * (len(rig.host.heads) == 22))
    assert rig.run().code == "stopped"
    assert len(rig.host.heads) > 25
    assert rig.flagged == [0]


def test_a_fault_in_the_sample_of_a_mark_leaves_the_output_low():
    rig = Rig(marks=np.array([20]), device=DigitalDouble(nan_at=20))
    assert rig.run().code == "fault"
    assert rig.device.pulses == pulses_at([20])


@pytest.mark.parametrize(("start", "high_from", "reads"), [("high", 300, 301), ("low", 0, 0)])
def test_start_by_the_input(start, high_from, reads):
    rig = Rig(start=start, device=DigitalDouble(high_from=high_from))
    rig.device.read_digital = {
        "high": rig.device.read_digital,
        "low": lambda: False,
    }[start]
    assert rig.run().code == "completed"
    assert rig.device.reads == reads
    waited_ns = max(reads - 1, 0) * MS
    event = rig.host.events[0]
    assert (event.sample, event.code) == (0, TRIGGERED)
    assert event.values["waited_s"] == pytest.approx(waited_ns * 1e-9)
    assert rig.host.start_ns == START_NS + waited_ns
    assert rig.device.firsts[0] == 0
    assert rig.host.heads[0][BlockHeader.DEADLINE_NS] == 0


def test_missing_start_signal_ends_the_run_at_the_safe_value():
    rig = Rig(start="high", timeout_s=0.5, device=DigitalDouble(high_from=10**9))
    outcome = rig.run()
    assert (outcome.code, outcome.output) == ("fault", "confirmed")
    assert rig.codes == ["start_timeout"]
    assert rig.device.reads == 501
    assert set(rig.device.commands) == {0.0}


def test_a_stop_ends_the_wait():
    rig = Rig(
        start="high",
        timeout_s=60.0,
        device=DigitalDouble(high_from=10**9),
        stop=lambda: "asked" * (len(rig.host.heartbeats) > 20),
    )
    outcome = rig.run()
    assert (outcome.code, outcome.reason, outcome.output) == ("stopped", "asked", "confirmed")
    assert set(rig.device.commands) == {0.0}


def test_a_device_that_is_lost_in_the_wait_is_made_safe():
    def lost():
        raise DeviceError("lost")

    rig = Rig(start="high")
    rig.device.read_digital = lost
    assert rig.run().code == "fault"
    assert rig.device.made_safe == [0.0]


def test_a_run_waits_at_the_safe_value_only():
    rig = Rig(start="high", device=DigitalDouble(output_at_open=1.0))
    with pytest.raises(InputError, match="safe value"):
        rig.run()
    assert rig.device.commands == []
