"""The lead-in before a waveform: its parts, and the removed offset."""

import math

import numpy as np
import pytest

from hilctl.base.events import OFFSET, ZERO
from hilctl.base.samples import Flag
from hilctl.loop.lead_in import Conditioning, LeadIn
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice
from tests.published import terfenol_rdpi
from tests.unit.loop.test_loop import LIMITS, RATE_HZ, Rig, sine

COMMAND = np.arange(40.0)


def short_conditioning(**options):
    return Conditioning(COMMAND, rest=(30, 40), cycle_samples=20, **options)


def test_invalid_readings_at_rest_are_omitted():
    beginning = LeadIn(short_conditioning(), 0)
    for first, readings in [(30, [np.nan, np.nan]), (32, [1.0, 3.0]), (34, [np.nan, 2.0])]:
        beginning.take(first, np.array(readings))
    assert beginning.resting_um == pytest.approx(2.0)
    assert math.isfinite(beginning.noise_um)


CYCLE = np.concatenate((2.0 * np.sin(np.arange(100) * np.pi / 25.0), np.zeros(40)))


def conditioning(latency=0, block=10, **options):
    command = np.concatenate((CYCLE, np.zeros(latency * block)))
    return Conditioning(command, rest=(120, 140), cycle_samples=100, **options)


class Biased(FakeDevice):
    """Shows 3 um more than ten times the command."""

    def exchange(self, first_sample, command, displacement_um, measured):
        super().exchange(first_sample, command, displacement_um, measured)
        displacement_um += 3.0


class TestLoop:
    @pytest.mark.parametrize("output", [0.0, 4.0])
    @pytest.mark.parametrize("latency", [0, 3])
    def test_it_comes_after_the_ramp_and_before_the_waveform(self, latency, output):
        device = FakeFifoDevice(latency, output) if latency else FakeDevice(output)
        given = conditioning(latency)
        rig = Rig(sine(230), block=10, device=device, conditioning=given)
        assert rig.run().code == "completed"
        ramp = 40 if output else 0
        n = ramp + given.command.size
        assert rig.waveform_at == n
        assert device.commands[ramp:n] == given.command.tolist()
        assert device.commands[n : n + 230] == sine(230).tolist()
        flags = np.concatenate(rig.host.flags)
        assert (flags[ramp:n] == Flag.CONDITION).all()
        assert not (flags[n:] & Flag.CONDITION).any()
        assert np.isnan(rig.host.column(0)[:n]).all()
        assert np.isnan(rig.host.column(5)[:n]).all()
        (event,) = (each for each in rig.host.events if each.code == "condition")
        assert (event.sample, event.values["cycle_samples"]) == (ramp, 100.0)

    def test_it_passes_the_limiter(self):
        command = np.concatenate((np.full(20, 9.0), np.zeros(20)))
        given = Conditioning(command, rest=(30, 40), cycle_samples=20)
        rig = Rig(sine(50), block=10, conditioning=given)
        assert rig.run().code == "completed"
        commands = np.array(rig.device.commands)
        assert commands[:40].max() == LIMITS.high
        assert np.abs(np.diff(commands, prepend=0.0)).max() <= LIMITS.slew_per_s / RATE_HZ + 1e-12
        flags = np.concatenate(rig.host.flags)[:20]
        assert (flags & (Flag.RANGE_LIMITED | Flag.SLEW_LIMITED)).all()

    def test_an_interlock_ends_the_run_in_it(self):
        rig = Rig(sine(50), conditioning=conditioning(block=1), stroke_um=(-15.0, 15.0))
        outcome = rig.run()
        assert (outcome.code, outcome.safe) == ("fault", True)
        assert "stroke limits" in outcome.reason
        assert outcome.ended_at < 60
        assert np.isnan(rig.host.column(0)).all()
        assert rig.device.commands[-1] == LIMITS.safe

    def test_a_stop_on_the_way_to_it(self):
        rig = Rig(
            sine(50), device=FakeDevice(4.0), conditioning=conditioning(block=1), stop=lambda: "x"
        )
        assert rig.run().code == "stopped"
        assert "condition" not in {event.code for event in rig.host.events}
        assert not any(flags[0] & Flag.CONDITION for flags in rig.host.flags)

    def test_a_stop_leaves_it_by_the_safe_ramp(self):
        beats = iter(range(10_000))
        rig = Rig(
            sine(50),
            conditioning=conditioning(block=1),
            stop=lambda: "asked" if next(beats) >= 13 else "",
        )
        outcome = rig.run()
        assert (outcome.code, outcome.safe) == ("stopped", True)
        commands = np.array(rig.device.commands)
        assert outcome.ended_at < 60
        assert np.abs(np.diff(commands[13:])).max() <= LIMITS.ramp_per_s / RATE_HZ + 1e-12

    def test_late_ticks_skip_none_of_it(self):
        clock = FakeClock(stall_ns={20: 15_000_000, 123: 30_000_000, 139: 5_000_000})
        rig = Rig(sine(50), conditioning=conditioning(block=1), clock=clock)
        assert rig.run().code == "completed"
        assert rig.firsts == list(range(len(rig.firsts)))
        assert rig.device.commands[:190] == [*CYCLE, *sine(50)]


class TestOffset:
    @pytest.mark.parametrize("block", [1, 10])
    @pytest.mark.parametrize("latency", [0, 3])
    def test_offset_between_sensor_and_model_is_removed(self, latency, block):
        device = FakeFifoDevice(latency) if latency else FakeDevice()
        given = conditioning(latency, block, stands_um=-3.0, lead_in=50)
        rig = Rig(
            10.0 * sine(200), block=block, device=device, model=terfenol_rdpi(), conditioning=given
        )
        assert rig.run().code == "completed"
        reference, fed = (rig.host.column(row)[rig.waveform_at :][:200] for row in (0, 5))
        assert reference.tolist() == (10.0 * sine(200)).tolist()
        taken_um = fed - reference
        assert taken_um[0] == pytest.approx(0.0, abs=0.01)
        np.testing.assert_allclose(taken_um[49:], -3.0, atol=1e-12)
        assert np.abs(np.diff(taken_um)).max() < 0.1
        (event,) = (each for each in rig.host.events if each.code == OFFSET)
        assert event.sample == rig.waveform_at
        assert dict(event.values) == {"offset_um": 3.0, "resting_um": 0.0, "model_um": -3.0}

    def test_no_offset_is_removed_without_a_measurement(self):
        rig = Rig(sine(50), device=Biased(), conditioning=conditioning(block=1))
        assert rig.run().code == "completed"
        assert rig.host.column(5)[140:190].tolist() == sine(50).tolist()

    def test_an_offset_beyond_the_limit_ends_the_run(self):
        given = conditioning(block=1, stands_um=-3.0, largest_um=2.0)
        rig = Rig(sine(50), conditioning=given)
        outcome = rig.run()
        assert (outcome.code, outcome.safe) == ("fault", True)
        assert "offset beyond 2 µm" in outcome.reason
        assert np.isnan(rig.host.column(0)).all()

    def test_no_reading_is_no_offset(self):
        resting = LeadIn(conditioning(stands_um=0.0), 40)
        resting.take(150, np.zeros(10))
        assert math.isnan(resting.resting_um)
        given = conditioning(block=1, stands_um=math.nan)
        outcome = Rig(sine(50), conditioning=given).run()
        assert (outcome.code, "the model nan µm" in outcome.reason) == ("fault", True)

    @pytest.mark.parametrize("size", [1, 7, 20, 200])
    def test_mean_and_noise_of_the_rest(self, size):
        """Mean and standard deviation of the samples at rest, also far from 0."""
        shown = 1e5 + np.random.default_rng(1).normal(0.0, 0.03, 220)
        resting = LeadIn(conditioning(), 40)
        assert math.isnan(resting.resting_um)
        assert math.isnan(resting.noise_um)
        for first in range(0, 220, size):
            resting.take(first, shown[first : first + size])
        assert resting.resting_um == pytest.approx(shown[160:180].mean(), rel=1e-12)
        assert resting.noise_um == pytest.approx(shown[160:180].std(), rel=1e-6)


class BiasedFifo(FakeFifoDevice):
    """Shows 3 um more than ten times the command, some blocks later."""

    def exchange(self, first_sample, command, displacement_um, measured):
        super().exchange(first_sample, command, displacement_um, measured)
        displacement_um += 3.0


class TestZero:
    @pytest.mark.parametrize("latency", [0, 3])
    def test_readings_after_the_rest_are_less_by_its_mean(self, latency):
        device = BiasedFifo(latency) if latency else Biased()
        given = conditioning(latency, stands_um=1.0, zero=True)
        rig = Rig(sine(200), block=10, device=device, conditioning=given)
        assert rig.run().code == "completed"
        (event,) = (each for each in rig.host.events if each.code == ZERO)
        assert event.sample == rig.waveform_at - 10 * latency
        assert dict(event.values) == {"offset_um": 2.0, "resting_um": 3.0, "model_um": 1.0}
        moved = rig.host.column(3)
        reading = moved + np.where(np.arange(moved.size) < event.sample, 0.0, 2.0)
        expected = 3.0 + 10.0 * np.array([0.0, *rig.device.commands])[: reading.size]
        np.testing.assert_allclose(reading, expected, atol=1e-9)
        assert rig.host.column(5)[rig.waveform_at :][:200].tolist() == sine(200).tolist()

    def test_interlocks_use_the_zeroed_displacement(self):
        given = conditioning(block=1, stands_um=0.0, zero=True)
        options = {"device": Biased(), "stroke_um": (-31.0, 31.0), "conditioning": given}
        assert Rig(sine(50), **options).run().code == "completed"
        rig = Rig(sine(50), **options | {"conditioning": conditioning(block=1)})
        assert "stroke limits" in rig.run().reason

    def test_a_zero_beyond_the_limit_ends_the_run(self):
        given = conditioning(block=1, stands_um=0.0, zero=True, largest_um=2.0)
        outcome = Rig(sine(50), device=Biased(), conditioning=given).run()
        assert (outcome.code, "beyond 2 µm" in outcome.reason) == ("fault", True)
