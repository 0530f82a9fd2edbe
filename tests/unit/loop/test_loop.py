"""The loop, with a fake device and clock."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.base.events import LOST_READINGS
from hilctl.base.samples import COLUMNS, BlockHeader, Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import LateRules
from hilctl.loop.tuning import LinearBypass, Tuning
from hilctl.models.model_file import load_model
from tests.fakes import FakeClock, FakeDevice, FakeFifoDevice, FakeHost, FakeInfo, loop_plan
from tests.published import terfenol_rdpi

RATE_HZ = 1000.0
LIMITS = CommandLimits(low=-5.0, high=5.0, slew_per_s=2000.0, safe=0.0, ramp_per_s=100.0)


class Rig:
    """One loop with all its parts, to be run once."""

    def __init__(self, reference, *, block=1, device=None, clock=None, **options):
        model = options.get("model")
        compensator = Compensator(model, RATE_HZ)
        host_options = {k: options[k] for k in ("full", "stop", "tunings") if k in options}
        self.device = device or FakeDevice()
        self.host = FakeHost(
            clock or FakeClock(), block, compensator.state_size + 1, **host_options
        )
        late = {"late_after_ns": 0.5e9 * block / RATE_HZ, "max_late_ns": 1e9}
        plan = loop_plan(
            reference=reference,
            input_um=options.get("input_um", reference),
            block=block,
            latency_blocks=getattr(self.device, "latency", 0),
            sample_rate_hz=RATE_HZ,
            compensator=compensator,
            limits=options.get("limits", LIMITS),
            interlocks=InterlockContext(stroke_um=options.get("stroke_um", (-60.0, 60.0))),
            late_policy=options.get("policy", "skip"),
            late_rules=LateRules(**{**late, **options.get("late", {})}),
            feedback=options.get("feedback"),
            adaptation=options.get("adaptation"),
            conditioning=options.get("conditioning"),
            keep_all=options.get("keep_all", False),
        )
        self.loop = Loop(plan, [self.device], self.host)

    def run(self):
        self.waveform_at = self.loop.begin_at([self.device.output()])
        return self.loop.run(1_000_000)

    @property
    def firsts(self):
        return [head[BlockHeader.FIRST_SAMPLE] for head in self.host.heads]

    @property
    def gaps(self):
        """Samples dropped before a recorded block, by its first sample."""
        dropped = [head[BlockHeader.DROPPED_BEFORE] for head in self.host.heads]
        return {first: n for first, n in zip(self.firsts, dropped, strict=True) if n}


def sine(n=200, amplitude=3.0):
    return amplitude * np.sin(2 * np.pi * 5.0 * np.arange(n) / RATE_HZ)


@pytest.mark.parametrize("block", [1, 7, 50])
def test_waveform_then_ramp(block):
    rig = Rig(sine(230), block=block)
    outcome = rig.run()
    assert (outcome.code, outcome.safe) == ("completed", True)
    commands = rig.device.commands
    assert commands[:230] == sine(230).tolist()
    assert commands[-1] == LIMITS.safe
    assert np.abs(np.diff(commands[230:])).max() <= LIMITS.ramp_per_s / RATE_HZ * (1 + 1e-9)
    assert outcome.ended_at == len(commands)


def test_work_before_the_exchange_is_lateness():
    clock = FakeClock()

    def stop():
        if rig.host.heartbeats and rig.host.heartbeats[-1] == 30:
            clock.now += 700_000
            return "asked"
        return ""

    rig = Rig(sine(), clock=clock, stop=stop)
    rig.run()
    late_ns = {head[BlockHeader.FIRST_SAMPLE]: head[BlockHeader.LATE_NS] for head in rig.host.heads}
    assert late_ns[30] == 700_000
    assert set(late_ns.values()) == {0, 700_000}


def test_block_size_makes_no_difference():
    commands = []
    for block in (1, 8, 40):
        rig = Rig(10.0 * sine(400), block=block, model=terfenol_rdpi())
        rig.run()
        commands.append(rig.device.commands[:400])
    assert commands[0] == commands[1] == commands[2]


def test_each_sample_is_recorded_with_what_belongs_to_it():
    rig = Rig(10.0 * sine(100), block=10, model=terfenol_rdpi())
    rig.run()
    assert rig.firsts == list(range(0, 10 * len(rig.firsts), 10))
    assert rig.host.column(0)[:100].tolist() == (10.0 * sine(100)).tolist()
    assert np.isnan(rig.host.column(0)[100:]).all()
    assert rig.host.column(2).tolist() == rig.device.commands
    flags = np.concatenate(rig.host.flags)
    assert not (flags[:100] & Flag.RAMP).any()
    assert (flags[100:] & Flag.RAMP).all()


@pytest.mark.parametrize("latency", [0, 4])
def test_state_before_a_block_is_recorded(latency):
    model = terfenol_rdpi()
    rig = Rig(10.0 * sine(200), block=10, model=model, device=FakeFifoDevice(latency))
    rig.run()
    again = Compensator(model, RATE_HZ)
    again.restore(rig.host.states[6][:-1])
    wanted = np.empty(10)
    again.process(np.ascontiguousarray(rig.host.columns[6][0]), wanted)
    assert wanted.tolist() == rig.host.columns[6][1].tolist()
    assert rig.host.states[6][-1] == rig.host.columns[5][2][-1]


@pytest.mark.parametrize("block", [1, 7, 50])
def test_input_is_recorded_beside_the_reference(block):
    reference, model = 10.0 * sine(230), terfenol_rdpi()
    ahead = np.concatenate((reference[4:], np.full(4, reference[-1]))) + 0.25
    rig = Rig(reference, block=block, model=model, input_um=ahead)
    assert rig.run().code == "completed"
    assert rig.host.column(0)[:230].tolist() == reference.tolist()
    assert rig.host.column(5)[:230].tolist() == ahead.tolist()
    assert np.isnan(rig.host.column(5)[230:]).all()
    wanted = model.inverse(RATE_HZ).process(ahead.copy())
    assert rig.host.column(1)[:230].tolist() == wanted.tolist()


def test_tuning_moves_reference_and_input_equally():
    reference = 10.0 * sine(200)
    ahead = np.concatenate((reference[4:], np.full(4, reference[-1])))
    tunings = {40: Tuning(0.5, 0.1, 20)}
    rig = Rig(reference, block=10, model=terfenol_rdpi(), input_um=ahead, tunings=tunings)
    rig.run()
    ramp = np.clip((np.arange(200) - 39) / 20, 0.0, 1.0)
    gains, offsets = 1.0 - 0.5 * ramp, 0.1 * ramp
    np.testing.assert_allclose(rig.host.column(0)[:200], gains * reference + offsets)
    np.testing.assert_allclose(rig.host.column(5)[:200], gains * ahead + offsets)
    (event,) = rig.host.events
    assert (event.sample, event.code, event.values["samples"]) == (40, "tuned", 20)


def test_reference_is_the_command_without_a_compensator():
    rig = Rig(sine(50))
    rig.run()
    for row in (0, 1, 5):
        assert rig.host.column(row)[:50].tolist() == sine(50).tolist()
    assert np.isnan(rig.host.column(0)[50:]).all()


def test_stop_request_ramps_down():
    asked = iter([""] * 53 + ["stopped by Ctrl-C"] * 1000)
    rig = Rig(np.full(1000, 2.0), stop=lambda: next(asked))
    outcome = rig.run()
    assert (outcome.code, outcome.reason) == ("stopped", "stopped by Ctrl-C")
    assert rig.device.commands[52] == 2.0
    assert rig.device.commands[-1] == 0.0
    assert len(rig.device.commands) == 53 + 20


@pytest.mark.parametrize("block", [1, 10])
def test_lost_sensor_ramps_down(block):
    rig = Rig(np.full(1000, 2.0), block=block, device=FakeDevice(nan_at=45))
    outcome = rig.run()
    assert outcome.code == "fault"
    assert "displacement at sample 45" in outcome.reason
    assert rig.device.commands[-1] == 0.0
    assert outcome.ended_at <= 45 + block + 30
    flags = np.concatenate(rig.host.flags)
    assert not (flags[:45] & Flag.SENSOR_INVALID).any()
    assert flags[45] & Flag.SENSOR_INVALID


def test_stroke_limit_ramps_down():
    rig = Rig(sine(200, 3.0), stroke_um=(-60.0, 25.0))
    outcome = rig.run()
    assert outcome.code == "fault"
    assert "stroke limits -60 to 25 µm" in outcome.reason
    assert max(rig.device.commands) < 3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_reference_that_is_not_a_number_ramps_down(bad):
    reference = np.full(100, 1.5)
    reference[40:] = bad
    rig = Rig(reference, block=5)
    outcome = rig.run()
    assert (outcome.code, outcome.safe) == ("fault", True)
    assert "sample 40" in outcome.reason
    assert np.isfinite(rig.device.commands).all()
    assert rig.device.commands[-1] == 0.0


def test_lost_device_is_made_safe():
    rig = Rig(np.full(1000, 2.0), device=FakeDevice(break_at=60, info=FakeInfo(simulated=True)))
    outcome = rig.run()
    assert (outcome.code, outcome.output) == ("fault", "confirmed")
    assert outcome.reason == "fake: no answer within 0.1 s"
    ramp = rig.device.made_safe
    assert ramp == sorted(ramp, reverse=True) == [*dict.fromkeys(rig.host.safe_writes)]
    assert (ramp[0] < 2.0, len(ramp) > 2, ramp[-1]) == (True, True, 0.0)
    assert outcome.ended_at == 61
    assert [event.code for event in rig.host.events] == ["device_lost"]
    assert rig.host.closed


def test_unconfirmed_end_is_not_safe():
    rig = Rig(np.full(100, 2.0), device=FakeDevice(info=FakeInfo(confirms=False)))
    outcome = rig.run()
    assert (outcome.code, outcome.output, outcome.safe) == ("completed", "sent", False)


def test_a_command_without_answer_may_be_executed_after_the_safe_value():
    rig = Rig(np.full(1000, 2.0), device=FakeDevice(break_at=60))
    assert rig.run().output == "set"


@dataclass
class WatchedDevice(FakeDevice):
    """A device with a watchdog; arming takes some time of the clock, or fails."""

    clock: FakeClock | None = None
    takes_ns: int = 0
    arm_fails: bool = False
    armed_ns: list[int] = field(default_factory=list)
    exchanged_ns: list[int] = field(default_factory=list)
    info: FakeInfo = field(default_factory=lambda: FakeInfo(simulated=True, arm_s=0.004))

    def arm(self):
        self.armed_ns.append(self.clock.now_ns())
        if self.arm_fails:
            raise DeviceError("fake: not armed")
        self.clock.sleep_until_ns(self.clock.now_ns() + self.takes_ns)

    def exchange(self, first_sample, command, displacement_um, measured):
        self.exchanged_ns.append(self.clock.now_ns())
        super().exchange(first_sample, command, displacement_um, measured)


@pytest.mark.parametrize("takes_ns", [0, 3_000_000, 7_000_000])
def test_the_watchdog_is_armed_just_before_the_first_exchange(takes_ns):
    clock = FakeClock()
    rig = Rig(sine(), device=WatchedDevice(clock=clock, takes_ns=takes_ns), clock=clock)
    start_ns = 50_000_000
    rig.loop.begin_at([0.0])
    outcome = rig.loop.run(start_ns)
    assert (outcome.code, rig.loop.lateness.late_ticks) == ("completed", 0)
    assert rig.device.armed_ns == [start_ns - 5_000_000]
    assert rig.device.exchanged_ns[0] == max(start_ns, start_ns - 5_000_000 + takes_ns)


def test_a_watchdog_that_cannot_be_armed_ends_as_an_exchange_that_fails():
    clock = FakeClock()
    rig = Rig(sine(), device=WatchedDevice(clock=clock, arm_fails=True), clock=clock)
    outcome = rig.run()
    assert (outcome.code, outcome.reason, outcome.safe) == ("fault", "fake: not armed", True)
    assert rig.device.made_safe[-1] == 0.0
    assert rig.device.commands == []
    assert [event.code for event in rig.host.events] == ["device_lost"]


def test_device_that_stays_lost_is_reported():
    rig = Rig(np.full(100, 2.0), device=FakeDevice(break_at=60, safe_works=False))
    outcome = rig.run()
    assert not outcome.safe
    assert "fake: still" in outcome.reason


@pytest.mark.parametrize("latency", [0, 3])
def test_an_interlock_that_trips_after_a_stop_is_recorded(latency):
    asked = iter([""] * 40)
    device = FakeFifoDevice(latency, nan_at=43) if latency else FakeDevice(nan_at=43)
    rig = Rig(np.full(1000, 2.0), device=device, stop=lambda: next(asked, "stopped by a test"))
    outcome = rig.run()
    assert (outcome.code, outcome.reason) == ("stopped", "stopped by a test")
    (event,) = rig.host.events
    assert (event.level, event.sample) == ("error", 43)
    assert event.code == "sensor_invalid"


def test_device_lost_on_the_ramp_keeps_the_first_reason():
    device = FakeDevice(nan_at=40, break_at=45)
    outcome = Rig(np.full(1000, 2.0), device=device).run()
    assert outcome.reason.startswith("displacement at sample 40")
    assert "; then fake: " in outcome.reason


def test_very_late_tick_ends_the_run():
    clock = FakeClock(stall_ns={30: 2_000_000_000})
    rig = Rig(np.full(10_000, 2.0), clock=clock)
    outcome = rig.run()
    assert outcome.code == "fault"
    assert "woke 2.000 s late" in outcome.reason
    assert "exchange" not in outcome.reason
    assert rig.device.commands[-1] == 0.0


def test_late_tick_after_a_slow_exchange_names_the_exchange():
    clock, device = FakeClock(), FakeDevice()
    answered = device.exchange

    def exchange(first_sample, *arrays):
        answered(first_sample, *arrays)
        clock.now += 2_000_000_000 * (first_sample == 30)

    device.exchange = exchange
    outcome = Rig(np.full(10_000, 2.0), clock=clock, device=device).run()
    assert (outcome.code, "took 2.000 s" in outcome.reason) == ("fault", True)


def test_skipped_ticks_are_a_counted_gap():
    clock = FakeClock(stall_ns={30: 5_000_000})
    rig = Rig(sine(200), clock=clock)
    assert rig.run().code == "completed"
    assert rig.gaps == {35: 5}
    at = rig.firsts.index(35)
    assert rig.host.columns[at][1][0] == sine(200)[35]
    due_ns = [1_000_000 * first for first in rig.firsts]
    assert [head[BlockHeader.DEADLINE_NS] for head in rig.host.heads] == due_ns


@pytest.mark.parametrize("latency", [0, 3])
def test_full_ring_is_a_counted_gap(latency):
    device = FakeFifoDevice(latency)
    rig = Rig(sine(200), block=10, device=device, full=range(50, 80))
    outcome = rig.run()
    assert rig.gaps == {80: 30}
    assert len(rig.device.commands) == outcome.ended_at + 10 * latency


def test_ticks_record_deadline_lateness_and_exchange():
    rig = Rig(sine(20), clock=FakeClock(stall_ns={3: 120_000}))
    rig.run()
    ticks = [(head[BlockHeader.DEADLINE_NS], head[BlockHeader.LATE_NS]) for head in rig.host.heads]
    assert ticks[:5] == [(k * 10**6, 120_000 if k == 3 else 0) for k in range(5)]


LATENCIES = [1, 3, 8]


@pytest.mark.parametrize("latency", LATENCIES)
def test_delayed_displacements_are_recorded_with_their_commands(latency):
    rig = Rig(sine(230), block=10, device=FakeFifoDevice(latency))
    outcome = rig.run()
    plain = Rig(sine(230), block=10)
    assert (outcome.code, outcome.safe) == ("completed", True)
    assert outcome.ended_at == plain.run().ended_at
    assert [head[:4] for head in rig.host.heads] == [head[:4] for head in plain.host.heads]
    for row in (1, 2, 3):
        assert rig.host.column(row).tolist() == plain.host.column(row).tolist()
    assert rig.host.column(4).tolist() == rig.host.column(2).tolist()
    assert np.concatenate(rig.host.flags).tolist() == np.concatenate(plain.host.flags).tolist()


@pytest.mark.parametrize("latency", LATENCIES)
def test_last_blocks_are_awaited_at_the_safe_value(latency):
    device = FakeFifoDevice(latency)
    outcome = Rig(sine(230), block=10, device=device).run()
    assert len(device.commands) == outcome.ended_at + 10 * latency
    assert set(device.commands[outcome.ended_at :]) == {LIMITS.safe}


@pytest.mark.parametrize("latency", LATENCIES)
@pytest.mark.parametrize("nan_at", [45, 995])
def test_sensor_lost_behind_a_fifo_ramps_down(latency, nan_at):
    device = FakeFifoDevice(latency, nan_at=nan_at)
    rig = Rig(np.full(1000, 2.0), block=10, device=device)
    outcome = rig.run()
    assert (outcome.code, outcome.safe) == ("fault", True)
    assert f"displacement at sample {nan_at} " in outcome.reason
    assert outcome.ended_at <= nan_at + 10 * latency + 40
    assert device.commands[-1] == LIMITS.safe
    assert rig.host.column(2).size == outcome.ended_at
    flags = np.concatenate(rig.host.flags)
    assert not (flags[:nan_at] & Flag.SENSOR_INVALID).any()
    assert (flags[nan_at:] & Flag.SENSOR_INVALID).all()


@pytest.mark.parametrize(
    ("latency", "break_at"), [(3, 5), (3, 25), (3, 60), (3, 205), (3, 235), (0, 60)]
)
def test_unanswered_blocks_of_a_lost_device_are_recorded(latency, break_at):
    device = FakeFifoDevice(latency, break_at=break_at)
    rig = Rig(sine(200), block=10, device=device)
    outcome = rig.run()
    assert outcome.code == "fault"
    assert outcome.reason.startswith("fake: no answer within 0.1 s")
    assert device.made_safe[-1] == LIMITS.safe
    recorded = rig.host.column(2)
    assert recorded.size == outcome.ended_at
    known = min(len(device.commands), recorded.size)
    assert recorded[:known].tolist() == device.commands[:known]
    answered = max(0, 10 * (device.exchanges - latency))
    assert np.isnan(rig.host.column(3)[answered:]).all()
    assert np.isfinite(rig.host.column(3)[:answered]).all()
    flags = np.concatenate(rig.host.flags)
    assert ((flags & Flag.UNANSWERED) != 0).tolist() == [
        k >= answered for k in range(recorded.size)
    ]


@pytest.mark.parametrize("latency", [0, 3])
def test_blocks_are_published_before_they_are_sent(latency):
    seen = []

    class Looked(FakeFifoDevice):
        def exchange(self, first_sample, command, displacement_um, measured):
            seen.append(rig.host.sent[-1] == (first_sample, command.tolist()))
            super().exchange(first_sample, command, displacement_um, measured)

    rig = Rig(sine(100), block=10, device=Looked(latency))
    outcome = rig.run()
    assert outcome.ended_at > 100
    assert all(seen[: outcome.ended_at // 10])


def test_heartbeat_in_every_tick():
    asked = iter([""] * 20)
    rig = Rig(np.full(1000, 2.0), stop=lambda: next(asked, "stopped by a test"))
    outcome = rig.run()
    assert (outcome.code, outcome.reason) == ("stopped", "stopped by a test")
    assert rig.host.heartbeats == list(range(outcome.ended_at))


@pytest.mark.parametrize("block", [1, 8])
def test_stop_in_the_ramp_after_the_waveform_changes_nothing(block):
    n = 4 * block + 3
    asked = iter([""] * -(-n // block))
    rig = Rig(np.full(n, 2.0), block=block, stop=lambda: next(asked, "stopped by a test"))
    outcome = rig.run()
    assert outcome.ended_at > n + block
    assert (outcome.code, outcome.reason) == ("completed", "waveform completed")


def test_tuning_in_the_ramp_after_the_waveform_is_not_taken():
    rig = Rig(np.full(10, 2.0), tunings={12: Tuning(0.5, 0.0, 1)})
    assert rig.run().ended_at > 12
    assert rig.host.requested
    assert not rig.host.events


def test_invalid_request_in_the_last_block_is_a_fault():
    reference = np.full(11, 2.0)
    reference[-1] = np.nan
    outcome = Rig(reference, block=8).run()
    assert outcome.code == "fault"
    assert "sample 10" in outcome.reason


def test_recorder_that_does_not_keep_up_ends_the_run():
    rig = Rig(sine(200), block=10, full=range(50, 60), keep_all=True)
    outcome = rig.run()
    assert outcome.code == "fault"
    assert outcome.reason == "no room for sample 50: the recorder does not keep up"


CONFIGS = Path(__file__).parents[3] / "configs" / "models"
MODELS = ["terfenol_rdpi", "terfenol_omega", "terfenol_staged", "terfenol_staged_preisach"]


@pytest.mark.parametrize("late", [1, 3, 20])
@pytest.mark.parametrize("frequency_hz", [1.0, 50.0, 250.0])
@pytest.mark.parametrize("name", MODELS)
def test_command_after_skipped_ticks_is_the_one_that_was_due(name, frequency_hz, late):
    model = load_model(CONFIGS / f"{name}.yaml")
    reference = 8.0 * np.sin(2 * np.pi * frequency_hz / RATE_HZ * np.arange(200))
    plain = Rig(reference, model=model)
    plain.run()
    rig = Rig(reference, model=model, clock=FakeClock(stall_ns={60: late * 1_000_000}))
    rig.run()
    at = rig.firsts.index(60 + late)
    assert rig.host.columns[at][1][0] == plain.host.columns[60 + late][1][0]
    assert (
        rig.host.column(1)[at:140].tolist() == plain.host.column(1)[60 + late : 140 + late].tolist()
    )
    assert rig.host.flags[at][0] & Flag.AFTER_SKIPPED
    assert not any(flags[0] & Flag.AFTER_SKIPPED for flags in rig.host.flags[:at])


def test_skipped_ticks_move_a_tuning_on():
    rig = Rig(
        np.full(200, 2.0),
        model=terfenol_rdpi(),
        tunings={40: Tuning(0.5, 0.0, 40)},
        clock=FakeClock(stall_ns={50: 10_000_000}),
    )
    rig.run()
    at = rig.firsts.index(60)
    assert rig.host.columns[at][0][0] == pytest.approx(2.0 * (1.0 - 0.5 * 21 / 40))


def test_enabled_inverse_has_the_memory_of_one_never_bypassed():
    reference = 10.0 * sine(400)
    line = LinearBypass(0.1, 0.25)
    out, back = Tuning(1.0, 0.0, 20, 0.0, line), Tuning(1.0, 0.0, 30, 1.0, line)
    rig = Rig(reference, block=10, model=terfenol_rdpi(), tunings={50: out, 200: back})
    plain = Rig(reference, block=10, model=terfenol_rdpi())
    for each in (rig, plain):
        each.run()
    commands, untouched = rig.host.column(1), plain.host.column(1)
    assert (commands[70:200] == 0.1 * reference[70:200] + 0.25).all()
    away = np.concatenate(rig.host.flags) == Flag.INVERSE_OUT
    assert np.flatnonzero(away).tolist() == list(range(50, 229))
    assert commands[~away].tobytes() == untouched[~away].tobytes()
    assert [(each.sample, each.code) for each in rig.host.events] == [
        (50, "inverse"),
        (200, "inverse"),
    ]


def test_skipped_ticks_move_a_fade_on():
    reference = np.linspace(0.0, 20.0, 200)
    out = Tuning(1.0, 0.0, 40, 0.0, LinearBypass(0.1, 0.0))
    rig = Rig(
        reference,
        model=terfenol_rdpi(),
        tunings={40: out},
        clock=FakeClock(stall_ns={50: 10_000_000}),
    )
    rig.run()
    at = rig.firsts.index(60)
    compensator, inverse = Compensator(terfenol_rdpi(), RATE_HZ), np.empty(61)
    compensator.process(reference[:61].copy(), inverse)
    share = 1.0 - 21 / 40
    expected = share * inverse[60] + (1.0 - share) * 0.1 * reference[60]
    assert rig.host.columns[at][1][0] == pytest.approx(expected, rel=1e-12)


def test_last_block_may_be_shorter():
    rig = Rig(np.full(204, 2.0), block=10)
    assert rig.run().code == "completed"
    assert rig.device.commands[203:205] == [2.0, 2.0 - LIMITS.ramp_per_s / RATE_HZ]


@dataclass
class AgingFakeDevice(FakeDevice):
    """A device with a streaming sensor: each reading is as old as its sample's number."""

    info: FakeInfo = field(
        default_factory=lambda: FakeInfo(ages_readings=True, corrects_readings=True)
    )
    lost_readings: int = 3
    reading_um: float = 7.0

    @property
    def reading_age_s(self):
        return float(len(self.commands) - 1)


@pytest.mark.parametrize("break_at", [10**9, 30])
def test_the_age_of_each_reading_is_recorded_and_lost_ones_are_counted(break_at):
    rig = Rig(sine(50), device=AgingFakeDevice(break_at=break_at))
    rig.run()
    age_s = rig.host.column([*COLUMNS].index("reading_age_s"))
    ages = [*range(len(rig.device.commands))] + [np.nan] * (break_at == 30)
    assert np.array_equal(age_s, ages, equal_nan=True)
    reading_um = rig.host.column([*COLUMNS].index("reading_um"))
    assert np.array_equal(np.isnan(reading_um), np.isnan(ages))
    lost = [dict(each.values) for each in rig.host.events if each.code == LOST_READINGS]
    assert lost == [{"readings": 3}]
