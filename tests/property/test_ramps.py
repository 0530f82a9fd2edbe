"""The ramps before and after the waveform: sample by sample in, and by time out."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.analysis.replay import replay
from hilctl.base.samples import COLUMNS, BlockHeader, Flag, Samples
from hilctl.base.yaml import Document
from hilctl.experiment.file import Experiment
from hilctl.loop.lead_in import Conditioning
from hilctl.loop.tuning import Tuning
from hilctl.recording.reader import read
from hilctl.recording.recording import ReplayStart
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice
from tests.published import terfenol_rdpi
from tests.unit.loop.test_loop import LIMITS, RATE_HZ, Rig, sine

GOLDEN = Path(__file__).parents[2] / "recordings" / "golden" / "terfenol_uncompensated.mcap"
STEP = LIMITS.slew_per_s / RATE_HZ
RAMP_STEP = LIMITS.ramp_per_s / RATE_HZ


@dataclass
class SlowDevice(FakeDevice):
    """Takes its time for each exchange, and notes when its output moved: ``share`` of it later."""

    def __post_init__(self):
        self.clock = FakeClock()
        self.exchange_ns = lambda number: 0
        self.share = lambda number: 0.0
        self.sent_ns = []

    def exchange(self, first_sample, command, displacement_um, measured):
        super().exchange(first_sample, command, displacement_um, measured)
        number = len(self.sent_ns)
        took_ns = self.exchange_ns(number + 1)
        self.sent_ns.append(self.clock.now + self.share(number) * took_ns)
        self.clock.now += took_ns


def slow_rig(exchange_s, reference, **options):
    """Return a rig whose device takes so long for each exchange, by its number."""
    device = SlowDevice(output_at_open=options.pop("output", 0.0))
    device.exchange_ns = lambda number: round(exchange_s(number) * 1e9)
    return Rig(reference, device=device, clock=device.clock, **options)


class TestStart:
    """A run whose output is not at the safe value."""

    @given(
        start=st.floats(-20.0, 20.0) | st.sampled_from([0.0, 5.0, -5.0, 2.0, -2.0]),
        block=st.sampled_from([1, 7, 50]),
        latency=st.sampled_from([0, 3]),
    )
    def test_no_step_is_larger_than_the_slew_limit(self, start, block, latency):
        """In, on and outside the limits, as the device saw it."""
        device = FakeFifoDevice(latency, start) if latency else FakeDevice(start)
        reference = sine(200)
        rig = Rig(reference, block=block, device=device)
        outcome = rig.run()
        assert (outcome.code, outcome.safe) == ("completed", True)
        steps = np.abs(np.diff([start, *device.commands]))
        assert steps.max() <= STEP * (1 + 1e-9)
        n = rig.waveform_at
        assert n == 0 or steps[:n].max() <= RAMP_STEP * (1 + 1e-9)
        assert (n > 0) == (abs(start) > RAMP_STEP)
        assert n % block == 0
        if n:
            assert device.commands[n : n + 200] == reference.tolist()

    @pytest.mark.parametrize("latency", [0, 3])
    def test_the_ramp_is_recorded_before_the_waveform(self, latency):
        device = FakeFifoDevice(latency, 4.0) if latency else FakeDevice(4.0)
        rig = Rig(sine(230), block=10, device=device)
        outcome = rig.run()
        n = rig.waveform_at
        assert n == 40
        assert rig.firsts == list(range(0, outcome.ended_at, 10))
        assert rig.host.column(2).tolist() == device.commands[: outcome.ended_at]
        reference, flags = rig.host.column(0), np.concatenate(rig.host.flags)
        assert np.isnan(reference[:n]).all()
        assert (flags[:n] == Flag.RAMP).all()
        assert reference[n : n + 230].tolist() == sine(230).tolist()
        assert not flags[n : n + 230].any()
        (event,) = rig.host.events
        assert (event.sample, event.code) == (0, "start_ramp")
        assert event.values == {"output": 4.0, "samples": 40.0}

    def test_nothing_is_different_where_the_output_is_safe(self):
        rig = Rig(sine(230), block=10)
        rig.run()
        assert rig.waveform_at == 0
        assert rig.host.column(0)[:230].tolist() == sine(230).tolist()
        assert not rig.host.events

    def test_the_waveform_is_that_of_a_run_without_a_ramp(self):
        """The compensator sees none of the ramp, wherever that came from."""
        rigs = [Rig(10.0 * sine(300), model=terfenol_rdpi(), device=FakeDevice(x)) for x in (0, 4)]
        for rig in rigs:
            rig.run()
        plain, ramped = (rig.device.commands[rig.waveform_at :] for rig in rigs)
        assert ramped == plain

    @pytest.mark.parametrize("block", [1, 10])
    def test_a_stop_on_the_way_in_ends_at_the_safe_value(self, block):
        asked = iter([""] * 2 + ["stopped by Ctrl-C"] * 1000)
        device = FakeDevice(4.0)
        rig = Rig(np.full(1000, 2.0), block=block, device=device, stop=lambda: next(asked))
        outcome = rig.run()
        assert (outcome.code, outcome.reason) == ("stopped", "stopped by Ctrl-C")
        assert (outcome.ended_at, device.commands[-1]) == (40, 0.0)
        assert np.abs(np.diff([4.0, *device.commands])).max() <= RAMP_STEP * (1 + 1e-9)

    def test_readings_on_the_way_in_end_nothing(self):
        """They are flagged; the ramp to the safe value is all that could be done about them."""
        rig = Rig(sine(100), device=FakeDevice(9.0), stroke_um=(-40.0, 40.0))
        assert rig.run().code == "completed"
        flags = np.concatenate(rig.host.flags)
        assert flags[1] & Flag.SENSOR_INVALID
        assert not (flags[rig.waveform_at :] & Flag.SENSOR_INVALID).any()

    def test_a_reading_that_stays_bad_ends_the_waveform(self):
        rig = Rig(np.full(100, 1.0), device=FakeDevice(4.0, nan_at=10))
        outcome = rig.run()
        assert (outcome.code, rig.waveform_at) == ("fault", 40)
        assert "at sample 40" in outcome.reason

    def test_the_heartbeat_counts_the_waveform_s_samples(self):
        """0 until it begins, and a tuning that comes before waits for it."""
        tuning = Tuning(0.5, 0.0, 1)
        rig = Rig(np.full(100, 1.0), device=FakeDevice(4.0), tunings={0: tuning})
        rig.run()
        assert rig.host.heartbeats == [0] * 40 + list(range(len(rig.host.heartbeats) - 40))
        assert rig.host.column(0)[40:42].tolist() == [0.5, 0.5]
        assert [event.sample for event in rig.host.events] == [0, 40]

    def test_a_lost_device_on_the_way_in_is_made_safe(self):
        rig = Rig(sine(100), device=FakeDevice(4.0, break_at=20))
        outcome = rig.run()
        assert (outcome.code, outcome.ended_at, rig.device.made_safe[-1]) == ("fault", 21, 0.0)

    @pytest.mark.parametrize("stalled", [0, 1, 25, 29])
    def test_late_ticks_shift_the_schedule(self, stalled):
        plain = Rig(sine(300), device=FakeDevice(1.0 + STEP))
        plain.run()
        clock = FakeClock(stall_ns={stalled: 12_000_000})
        rig = Rig(sine(300), device=FakeDevice(1.0 + STEP), clock=clock)
        assert rig.run().code == "completed"
        assert rig.waveform_at == plain.waveform_at == 30
        assert rig.device.commands == plain.device.commands
        due_ns = [head[BlockHeader.DEADLINE_NS] for head in rig.host.heads]
        assert due_ns[stalled + 1] == 1_000_000 * (stalled + 1) + 12_000_000

    @given(data=st.data())
    def test_late_ticks_never_step_faster_than_the_slew_limit(self, data):
        """For each step and each time between two of them, up to the waveform's first sample.

        Wake-ups are late by up to 20 periods, exchanges take up to 5, and the output moves anywhere
        in them.
        """
        rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
        late_share = data.draw(st.sampled_from([0.02, 0.3, 1.0]))
        rows = np.where(rng.random((3, 120)) < late_share, rng.random((3, 120)), 0.0)
        device = SlowDevice(output_at_open=data.draw(st.floats(-4.5, 4.5)))
        device.exchange_ns = lambda number: round(5e6 * rows[0, (number - 1) % 120])
        device.share = lambda number: rows[1, number % 120]
        device.clock.stall_ns = {k: round(2e7 * rows[2, k % 120]) for k in range(1000)}
        conditioning = None
        if data.draw(st.booleans()):
            command = np.concatenate((4.0 * np.sin(np.arange(60) * np.pi / 5.0), np.zeros(10)))
            conditioning = Conditioning(command, rest=(60, 70), cycle_samples=60)
        rig = Rig(sine(20), device=device, clock=device.clock, conditioning=conditioning)
        rig.run()
        n = rig.waveform_at
        assert rig.firsts[:n] == list(range(n))
        steps = np.abs(np.diff([device.output_at_open, *device.commands[:n]]))
        apart_s = np.diff(device.sent_ns[: n + 1]) * 1e-9
        ramp = n - (70 if conditioning else 0)
        slews = np.where(np.arange(n) < ramp, LIMITS.ramp_per_s, LIMITS.slew_per_s)
        assert (steps <= slews / RATE_HZ * (1 + 1e-9)).all()
        assert (steps[1:] <= slews[1:] * apart_s[: n - 1] * (1 + 1e-9)).all()
        assert (apart_s >= (1 - 1e-9) / RATE_HZ).all()


class TestByTime:
    """A device that is late for each exchange."""

    @pytest.mark.parametrize("exchange_s", [0.05, 0.1, 0.4])
    def test_ramp_out_takes_its_time_and_not_its_ticks(self, exchange_s):
        """From 5 A, 0.05 s of ramp: four strides of a quarter each, and the tick that leaves."""
        stop_s, late_from = 0.3, 100
        rig = slow_rig(
            lambda number: exchange_s if number >= late_from else 0.0,
            np.full(10_000, 5.0),
            stop=lambda: "stopped" if rig.device.clock.now > stop_s * 1e9 else "",
        )
        assert rig.run().code == "stopped"
        sent_s, commands = np.array(rig.device.sent_ns) * 1e-9, np.array(rig.device.commands)
        leaving = np.flatnonzero(commands != 5.0)
        leaving = leaving[leaving > 10]
        took_s = sent_s[leaving[-1]] - sent_s[leaving[0]]
        assert commands[-1] == 0.0
        assert took_s <= max(0.05, 5 * exchange_s) + 1e-9
        steps, apart_s = np.abs(np.diff(commands)), np.diff(sent_s)
        late = steps[leaving[0] :]
        assert (late <= LIMITS.ramp_per_s * (apart_s[leaving[0] :] + 1.01 / RATE_HZ)).all()
        assert late.max() <= 0.25 * 5.0 * (1 + 1e-9)

    def test_a_ramp_of_seconds_takes_those_seconds(self):
        """From 5 A at 2 A/s, 50 to 400 ms an exchange."""
        rng = np.random.default_rng(1)
        waits = rng.uniform(0.05, 0.4, 10_000)
        limits = replace(LIMITS, ramp_per_s=2.0)
        rig = slow_rig(lambda number: waits[number], np.full(2000, 5.0), limits=limits)
        rig.run()
        on_ramp = np.array([flags[0] & Flag.RAMP for flags in rig.host.flags]) > 0
        leaving = np.flatnonzero(on_ramp)[0] - 1
        sent_s, commands = np.array(rig.device.sent_ns) * 1e-9, np.array(rig.device.commands)
        steps, apart_s = np.abs(np.diff(commands[leaving:])), np.diff(sent_s[leaving:])
        assert (steps <= limits.ramp_per_s * (apart_s + 1.01 / RATE_HZ)).all()
        assert np.ptp(sent_s[leaving:]) == pytest.approx(2.5, abs=0.5)

    def test_the_stall_before_the_ramp_is_not_made_up_for(self):
        clock = FakeClock(stall_ns={30: 2_000_000_000})
        rig = Rig(np.full(10_000, 5.0), clock=clock)
        assert "2.000 s late" in rig.run().reason
        assert rig.device.commands[30] == pytest.approx(5.0 - RAMP_STEP)

    def test_deadlines_go_on_through_the_ramp_out(self):
        rig = slow_rig(lambda number: 0.01, sine(100), output=4.0)
        rig.run()
        waited = [
            h[BlockHeader.DEADLINE_NS] - 1_000_000 * h[BlockHeader.FIRST_SAMPLE]
            for h in rig.host.heads
        ]
        assert waited[:41] == [10_000_000 * k for k in range(41)]
        assert set(waited[40:]) == {400_000_000}

    def test_ramps_with_gaps_are_replayed(self):
        golden = read(GOLDEN)
        slower = golden.experiment_yaml.replace("slew_a_per_s: 20000.0", "slew_a_per_s: 2000.0")
        slower = slower.replace("sample_rate_hz: 50000", f"sample_rate_hz: {RATE_HZ:g}")
        limits = Document("x", slower).validate(Experiment).command_limits()
        stalls = {360: 5_000_000, 380: 40_000_000}
        clock, device = FakeClock(stall_ns=stalls), FakeDevice(5.0)
        rig = Rig(
            np.full(200, 4.0), clock=clock, device=device, limits=limits, stroke_um=(-99.0, 99.0)
        )
        assert rig.run().code == "completed"
        gaps = [
            head[BlockHeader.FIRST_SAMPLE]
            for head in rig.host.heads
            if head[BlockHeader.DROPPED_BEFORE]
        ]
        assert len(gaps) == 2
        values = np.array([rig.host.column(row) for row in range(len(COLUMNS))])
        flags = np.concatenate(rig.host.flags)
        ramp = [flags[rig.firsts.index(first)] & Flag.RAMP for first in gaps]
        assert all(ramp)
        starts = [
            ReplayStart(first, state[:-1], state[-1])
            for first, state in zip(rig.firsts, rig.host.states, strict=True)
            if first in {0, *gaps}
        ]
        samples = Samples.of(np.array(rig.firsts), values, flags)
        made = replace(golden, samples=samples, starts=tuple(starts), sample_rate_hz=RATE_HZ)
        made = replace(made, experiment_yaml=slower)
        assert replay(made).identical
