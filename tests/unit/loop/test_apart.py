"""The difference of two axes: its interlock, and the common safe ramp after any trip."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.samples import BlockHeader, Flag
from hilctl.kernels.interlock import InterlockFlag, apart_block
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import ApartInterlock, ApartSettings, InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.plan import AxisPlan, LoopPlan
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice, FakeHost, made_block

RATE_HZ = 1000.0
LIMITS = CommandLimits(-5.0, 5.0, 2000.0, 0.0, 100.0)
APART = ApartSettings(axes=("left", "right"), um=5.0)


class Gantry:
    """A loop of two axes on devices that return ten times the previous command, run once."""

    def __init__(self, left, right, *, block=1, latency=0, apart=APART, stroke_um=60.0):
        made = [FakeFifoDevice(latency) if latency else FakeDevice() for _ in range(2)]
        self.devices, clock = made, FakeClock()
        self.lanes = [FakeHost(clock, block) for _ in made]
        host = FakeHost(clock)
        host.lanes = self.lanes
        axes = tuple(
            AxisPlan(
                reference=reference,
                input_um=reference,
                compensator=Compensator(None, RATE_HZ),
                limits=LIMITS,
                name=name,
                interlocks=InterlockContext(stroke_um=(-stroke_um, stroke_um)),
            )
            for name, reference in (("left", left), ("right", right))
        )
        plan = LoopPlan(axes, block, latency, RATE_HZ, apart=apart)
        loop = Loop(plan, made, host)
        loop.begin_at([each.output() for each in made])
        self.outcome = loop.run(1_000_000)

    def flagged(self, axis, flag):
        return np.flatnonzero(np.concatenate(self.lanes[axis].flags) & flag)


def sine(amplitude, hz=5.0, phase=0.0, n=400):
    return amplitude * np.sin(2.0 * np.pi * hz * np.arange(n) / RATE_HZ + phase)


@pytest.mark.parametrize(("block", "latency"), [(1, 0), (7, 0), (40, 3)])
def test_both_axes_ramp_and_record_it(block, latency):
    right = sine(1.0)
    right[203:] += 0.6  # 6 um in the reading after it
    found = Gantry(sine(1.0), right, block=block, latency=latency)
    assert found.outcome.code == "fault"
    assert found.outcome.reason.startswith("right: displacement +6 µm from left at sample 204")
    for axis, lane in enumerate(found.lanes):
        assert [(event.code, event.sample) for event in lane.events] == [("apart", 204)]
        assert found.flagged(axis, InterlockFlag.APART)[0] == 204
        assert lane.column(2)[-1] == 0.0
    begun = [found.flagged(axis, Flag.RAMP)[0] for axis in (0, 1)]
    assert begun[0] == begun[1] == (204 // block + latency + 1) * block


def test_a_trip_of_the_second_axis_takes_precedence():
    right = sine(1.0)
    right[200:] += 1.9
    found = Gantry(sine(1.0), right, stroke_um=15.0)
    assert found.outcome.reason.startswith("right: displacement 19")
    assert found.lanes[0].events[0].code == "stroke"
    assert found.flagged(0, InterlockFlag.APART)[0] == 201


def test_equal_axes_complete():
    assert Gantry(sine(3.0), sine(3.0)).outcome.code == "completed"
    assert Gantry(sine(3.0), sine(1.0), apart=None).outcome.code == "completed"


@given(
    sizes=st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 5.0)),
    phases=st.tuples(st.floats(0.0, 6.3), st.floats(0.0, 6.3)),
    um=st.floats(0.01, 60.0),
    stroke_um=st.floats(5.0, 60.0),
    shape=st.sampled_from([(1, 0), (7, 0), (40, 3)]),
    hz=st.floats(1.0, 20.0),
)
def test_the_safe_ramp_never_moves_two_equal_axes_apart(sizes, phases, um, stroke_um, shape, hz):
    """Their commands never differ by more than in the last sample before it, plus one step."""
    left, right = (sine(*each) for each in zip(sizes, (hz, hz), phases, strict=True))
    apart = ApartSettings(axes=("left", "right"), um=um)
    block, latency = shape
    made = Gantry(left, right, block=block, latency=latency, apart=apart, stroke_um=stroke_um)
    commands = [np.array(device.commands) for device in made.devices]
    difference = np.abs(commands[0] - commands[1])
    ramp = int(made.flagged(0, Flag.RAMP)[0])
    before = difference[ramp - 1] if ramp else 0.0
    assert difference[ramp:].max() <= before + LIMITS.ramp_per_s / RATE_HZ + 1e-12
    assert [each[-1] for each in commands] == [0.0, 0.0]


class Pair:
    """Blocks of both axes, judged one after another."""

    def __init__(self, for_s=0.0):
        settings = ApartSettings(axes=("left", "right"), um=5.0, for_s=for_s)
        self.interlock, self.first = ApartInterlock(settings, RATE_HZ), 0

    def feed(self, left, right, skipped=0):
        self.first += skipped
        self.blocks = [made_block(len(left)), made_block(len(left))]
        for block, values in zip(self.blocks, (left, right), strict=True):
            block.displacement_um[:] = values
            block.head[BlockHeader.FIRST_SAMPLE], block.skipped = self.first, skipped
        self.first += len(left)
        return self.interlock.judge(*self.blocks)

    def flags(self):
        return [np.flatnonzero(each.flags & InterlockFlag.APART).tolist() for each in self.blocks]


def test_the_first_sample_beyond_the_limit_trips():
    pair = Pair()
    assert pair.feed([0.0, 9.0], [5.0, 4.0]) is None
    trip = pair.feed([1.0, 1.0, 1.0], [1.0, 6.1, -4.1])
    assert (trip.sample, trip.code) == (3, "apart")
    assert pair.flags() == [[1, 2], [1, 2]]


def test_a_time_needs_consecutive_samples():
    pair = Pair(for_s=0.003)
    assert pair.feed([0.0] * 4, [6.0, 6.0, 6.0, 5.0]) is None
    assert pair.feed([0.0] * 2, [-6.0] * 2) is None
    assert pair.feed([0.0] * 3, [6.0] * 3).sample == 7


def test_skipped_samples_count_as_constant():
    pair = Pair(for_s=0.003)
    assert pair.feed([0.0], [4.0]) is None
    assert pair.feed([0.0], [6.0], skipped=10) is None
    assert pair.feed([0.0], [6.0], skipped=2).sample == 14


@pytest.mark.parametrize("missing", [(math.nan, 0.0), (0.0, math.nan)])
def test_a_missing_reading_neither_ends_nor_continues_the_time(missing):
    pair = Pair(for_s=0.001)
    assert pair.feed([0.0], [6.0]) is None
    assert pair.feed([missing[0]] * 3, [missing[1]] * 3) is None
    assert pair.feed([0.0], [6.0]).sample == 4


@pytest.mark.skipif(not hasattr(apart_block, "py_func"), reason="compilation is switched off")
def test_compiled_and_python_agree_bit_for_bit():
    left, right = np.random.default_rng(1).normal(0.0, 4.0, (2, 300))
    right[::7] = np.nan
    results = []
    for function in (apart_block, apart_block.py_func):
        run, flags = np.zeros(1), np.zeros((2, 300), dtype=np.uint32)
        first = function(5.0, 1.0, run, left, right, *flags)
        results.append((first, run.tolist(), flags.tolist()))
    assert results[0] == results[1]
    assert results[0][0] > 0
