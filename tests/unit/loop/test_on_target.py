"""The on-target flag: samples, events, and the digital output."""

import numpy as np
import pytest

from hilctl.base.events import ON_TARGET
from hilctl.base.samples import BlockHeader, Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.on_target import OnTarget, OnTargetSettings
from hilctl.loop.plan import AxisPlan, LoopPlan
from hilctl.loop.triggers import Triggers
from tests.fakes import FakeClock, FakeHost, made_block
from tests.unit.loop.test_triggers import DigitalDouble

RATE_HZ = 1000.0


def taken(errors_um, block=1, skipped_at=(), **settings):
    """Return the samples on target and the events, of errors in blocks."""
    target = OnTarget(OnTargetSettings(tolerance_um=0.1, **settings), RATE_HZ)
    flags, events = [], []
    for first in range(0, len(errors_um), block):
        made = made_block(block)
        made.head[BlockHeader.FIRST_SAMPLE] = first
        made.skipped = 5 * (first in skipped_at)
        made.reference[:] = 20.0
        made.displacement_um[:] = made.reference - errors_um[first : first + block]
        event = target.take(made)
        flags.append(made.flags.copy())
        events += [] if event is None else [event]
    return np.flatnonzero(np.concatenate(flags) & Flag.ON_TARGET).tolist(), events


def seen(events):
    return [(each.sample, each.values["on"], each.values["changes"]) for each in events]


@pytest.mark.parametrize("block", [1, 4, 12])
def test_samples_in_succession_within_the_tolerance(block):
    errors = np.full(12, 0.05)
    errors[[2, 9]] = 0.2, np.nan
    on, events = taken(errors, block, settle_s=0.003)
    assert on == [5, 6, 7, 8]
    assert events[0].code == ON_TARGET
    assert sum(each.values["changes"] for each in events) <= 2


def test_a_change_within_a_tenth_of_a_second_is_in_the_next_event():
    errors = np.full(400, 0.05)
    errors[[20, 30, 40, 300]] = -0.2
    assert seen(taken(errors)[1]) == [(0, 1.0, 1.0), (41, 1.0, 6.0), (300, 0.0, 1.0)]


def test_events_of_a_fast_reference_are_few():
    errors = np.tile([0.0, 0.2], 1000)
    on, events = taken(errors)
    assert len(on) == 1000
    assert len(events) == 20


def test_skipped_ticks_interrupt_it():
    on, _ = taken(np.zeros(12), skipped_at=[6], settle_s=0.002)
    assert on == [1, 2, 3, 4, 5, 7, 8, 9, 10, 11]


def run_axes(errors_um, *, tolerances_um=(0.1, 0.1)):
    """Return the first device, and the hosts, of two axes with errors in their displacements."""
    devices = [DigitalDouble() for _ in errors_um]
    clock = FakeClock()
    host, axes = FakeHost(clock), []
    host.lanes = [FakeHost(clock) for _ in errors_um]
    for name, error_um, tolerance_um in zip("xy", errors_um, tolerances_um, strict=True):
        # The double returns ten times the previous command.
        reference = np.zeros(40) + error_um
        settings = tolerance_um and OnTargetSettings(tolerance_um=tolerance_um, settle_s=0.002)
        axes.append(
            AxisPlan(
                reference=reference,
                input_um=np.zeros(40),
                compensator=Compensator(None, RATE_HZ),
                limits=CommandLimits(-5.0, 5.0, 1e4, 0.0, 100.0),
                interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
                name=name,
                on_target=settings and OnTarget(settings, RATE_HZ),
            )
        )
    triggers = Triggers(np.empty(0, np.int64), on_target=True)
    loop = Loop(LoopPlan(tuple(axes), 1, 0, RATE_HZ, triggers=triggers), devices, host)
    loop.begin_at([0.0, 0.0])
    loop.run(1_000_000)
    return devices[0], host.lanes


def late(samples):
    """Return the errors of an axis that reaches its target at a sample."""
    return np.where(np.arange(40) < samples, 1.0, 0.0)


def test_the_output_is_high_while_all_axes_are_on_target():
    device, lanes = run_axes([late(5), late(10)])
    for lane, first in zip(lanes, (6, 11), strict=True):
        flags = np.concatenate(lane.flags)
        assert np.flatnonzero(flags & Flag.ON_TARGET)[0] == first
        assert not (flags & Flag.TRIGGER).any()
        assert seen(lane.events)[0] == (first, 1.0, 1.0)
    # Set after the exchange of the next sample, reset with the safe ramp.
    assert device.pulses == [(12, True), (40, False)]


def test_an_axis_without_the_key_is_left_out():
    device, lanes = run_axes([late(5), late(41)], tolerances_um=(0.1, None))
    assert device.pulses[0] == (7, True)
    assert not (np.concatenate(lanes[1].flags) & Flag.ON_TARGET).any()
