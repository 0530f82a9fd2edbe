"""Several axes in one loop; test_loop.py tests one axis in all phases."""

from dataclasses import dataclass

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl.base.errors import DeviceError
from hilctl.base.samples import BlockHeader, Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.plan import AxisPlan, LoopPlan
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice, FakeHost
from tests.published import terfenol_rdpi

RATE_HZ = 1000.0
SINE = np.sin(2.0 * np.pi * 5.0 * np.arange(400) / RATE_HZ)


class Stage:
    """A loop of two axes, to be run once."""

    def __init__(self, *devices, block=1, axes=(0, 1), ramps_per_s=(100.0, 40.0), models=None):
        self.devices, self.clock = devices, FakeClock()
        models = models or [terfenol_rdpi(), None]
        plans, self.lanes = [], []
        for axis in axes:
            compensator = Compensator(models[axis], RATE_HZ)
            reference = (14.0 if models[axis] else 3.0) * (SINE if axis else np.roll(SINE, 50))
            limits = CommandLimits(-5.0, 5.0, 2000.0, 0.5 * axis, ramps_per_s[axis])
            device = devices[len(plans)]
            device.output_at_open = device.output_at_open or limits.safe
            plans.append(
                AxisPlan(
                    reference=reference,
                    input_um=reference,
                    compensator=compensator,
                    limits=limits,
                    name="xy"[axis],
                    interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
                )
            )
            self.lanes.append(FakeHost(self.clock, block, compensator.state_size + 1))
        self.host = FakeHost(self.clock)
        self.host.lanes = self.lanes
        latency = getattr(devices[0], "latency", 0)
        self.plan = LoopPlan(
            axes=tuple(plans), block=block, latency_blocks=latency, sample_rate_hz=RATE_HZ
        )
        self.loop = Loop(self.plan, devices, self.host)

    def run(self):
        self.loop.begin_at([each.output() for each in self.devices])
        return self.loop.run(1_000_000)

    def codes(self, axis):
        return [event.code for event in self.lanes[axis].events]


def devices(block, latency):
    return FakeFifoDevice(latency) if latency else FakeDevice()


@pytest.mark.parametrize(("block", "latency"), [(1, 0), (7, 0), (40, 3)])
def test_each_axis_is_its_own_run(block, latency):
    stage = Stage(devices(block, latency), devices(block, latency), block=block)
    assert stage.run().code == "completed"
    for axis in (0, 1):
        single = Stage(devices(block, latency), block=block, axes=(axis,))
        assert single.run().code == "completed"
        n = SINE.size
        for row in range(6):
            both, one = stage.lanes[axis].column(row)[:n], single.lanes[0].column(row)[:n]
            np.testing.assert_array_equal(both, one)


def test_all_axes_ramp_from_the_same_sample_each_at_its_own_rate():
    class Jumping(FakeDevice):
        def exchange(self, first_sample, command, displacement_um, measured):
            super().exchange(first_sample, command, displacement_um, measured)
            if first_sample == 120:
                displacement_um[:] = 80.0

    stage = Stage(FakeDevice(), Jumping())
    outcome = stage.run()
    assert (outcome.code, outcome.reason[:3]) == ("fault", "y: ")
    assert stage.codes(0) == stage.codes(1)
    for axis in (0, 1):
        ramp = np.flatnonzero(np.concatenate(stage.lanes[axis].flags) & Flag.RAMP)
        assert ramp[0] == 121  # the block after the one that shows it
        rate = (100.0, 40.0)[axis]
        steps = np.abs(np.diff(stage.devices[axis].commands[120:]))
        assert steps.max() <= rate / RATE_HZ * (1.0 + 1e-9)
        assert stage.devices[axis].commands[-1] == 0.5 * axis
    assert len(stage.devices[0].commands) == len(stage.devices[1].commands)


def test_the_slowest_lead_in_is_that_of_all_axes():
    slow = FakeDevice()
    slow.output_at_open = 4.5
    stage = Stage(FakeDevice(), slow)
    assert stage.run().code == "completed"
    firsts = [np.flatnonzero(np.isfinite(lane.column(0)))[0] for lane in stage.lanes]
    assert firsts == [100, 100]  # (4.5 - 0.5) / 40 per s


class LostDevice(FakeDevice):
    def __init__(self, at):
        super().__init__()
        self.at = at

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample >= self.at:
            raise DeviceError("no answer")
        super().exchange(first_sample, command, displacement_um, measured)

    def make_safe(self, command):
        raise DeviceError("no answer")


@pytest.mark.parametrize("lost", [0, 1])
def test_a_lost_device_leaves_the_other_one_safe(lost):
    made = [FakeDevice(), FakeDevice()]
    made[lost] = LostDevice(150)
    outcome = (stage := Stage(*made)).run()
    assert (outcome.code, outcome.output) == ("fault", "unknown")
    assert "xy"[lost] in outcome.reason
    assert stage.devices[1 - lost].made_safe[-1] == 0.5 * (1 - lost)
    for axis, lane in enumerate(stage.lanes):
        unanswered = np.concatenate(lane.flags) & Flag.UNANSWERED
        # x is exchanged first: its answer has arrived when y is lost.
        answered = axis == 0 and lost == 1
        assert [int(bool(each)) for each in unanswered[-2:]] == [0, int(not answered)]
        assert lane.heads[-1][BlockHeader.FIRST_SAMPLE] == 150


@dataclass
class Together:
    """The joint of two devices, whose exchange takes 3 us."""

    devices: list
    axes: list
    clock: FakeClock = None
    max_rate_hz = 1000.0
    rate_note = ""

    def exchange(self, first_sample, *blocks):
        for device, *each in zip(self.devices, *blocks, strict=True):
            device.exchange(first_sample, *each)
        self.clock.now += 3000


class JoinableDevice(FakeDevice):
    """A device that joins all others of its class."""

    def join(self, devices):
        found = {name: each for name, each in devices.items() if isinstance(each, JoinableDevice)}
        self.joint = Together([*found.values()], [*found])
        return self.joint if len(found) > 1 else None


def test_joined_devices_are_exchanged_at_once_with_the_results_of_devices_in_turn():
    one, other = JoinableDevice(), JoinableDevice()
    stage = Stage(one, other)
    one.joint.clock = stage.clock
    assert stage.run().code == "completed"
    in_turn = Stage(FakeDevice(), FakeDevice())
    in_turn.run()
    for axis in (0, 1):
        for row in range(6):
            both = (each.lanes[axis].column(row) for each in (stage, in_turn))
            np.testing.assert_array_equal(*both)
    late_ns, exchange_ns = BlockHeader.LATE_NS, BlockHeader.EXCHANGE_NS
    for x, y in zip(*(lane.heads for lane in stage.lanes), strict=True):
        assert (x[late_ns], x[exchange_ns]) == (y[late_ns], y[exchange_ns]) == (0, 3000)


def test_devices_that_share_nothing_stay_on_their_own():
    x, y, z = JoinableDevice(), FakeDevice(), JoinableDevice()
    units = joined({"x": x, "y": y, "z": z})
    assert [*units] == [("x", "z"), ("y",)]
    assert units["x", "z"].devices == [x, z]
    assert joined({"x": x, "y": y}) == {("x",): x, ("y",): y}


@pytest.mark.parametrize("latency", [0, 3])
def test_a_lost_joint_device_leaves_all_its_outputs_safe(latency):
    class Lost(Together):
        def exchange(self, first_sample, *blocks):
            if first_sample >= 150:
                raise DeviceError("no answer")
            super().exchange(first_sample, *blocks)

    made = [devices(1, latency), devices(1, latency)]
    joint = Lost(made, ["x", "y"])
    made[0].join = lambda _: joint
    stage = Stage(*made)
    joint.clock = stage.clock
    outcome = stage.run()
    assert (outcome.code, outcome.output) == ("fault", "set")
    for axis, lane in enumerate(stage.lanes):
        assert made[axis].made_safe[-1] == 0.5 * axis
        unanswered = np.concatenate(lane.flags) & Flag.UNANSWERED
        assert np.count_nonzero(unanswered) == 1 + latency
        assert lane.heads[-1][BlockHeader.FIRST_SAMPLE] == 150
