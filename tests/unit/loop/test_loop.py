"""The loop, with a device and a clock that the test makes."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.base.events import LoopEvent
from hilctl.base.samples import Batch, Flag, Head
from hilctl.loop.compensator import Compensator
from hilctl.loop.in_flight import DelayLine
from hilctl.loop.interlocks import InterlockLimits, Interlocks
from hilctl.loop.limiter import CommandLimits, Limiter
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import Pacer
from hilctl.loop.plan import Plan, Tuning
from hilctl.loop.tuning import tuning_samples
from hilctl.models.published import terfenol_rdpi

RATE_HZ = 1000.0
LIMITS = CommandLimits(low=-5.0, high=5.0, slew_per_s=2000.0, safe=0.0, ramp_per_s=100.0)


@dataclass
class FakeDevice:
    """Answers ten times the last command; may break at a sample."""

    break_at: int = 10**9
    nan_at: int = 10**9
    safe_works: bool = True
    commands: list[float] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample + command.size > self.break_at:
            raise DeviceError("fake: no answer within 0.1 s")
        self.firsts.append(first_sample)
        for j, value in enumerate(command):
            displacement_um[j] = 10.0 * (self.commands[-1] if self.commands else 0.0)
            if first_sample + j >= self.nan_at:
                displacement_um[j] = np.nan
            self.commands.append(float(value))

    def make_safe(self, command):
        if not self.safe_works:
            raise DeviceError("fake: still no answer")
        self.made_safe.append(command)


@dataclass
class FifoDevice:
    """Plays blocks later: the displacement of each sample is ten times the command before it.

    It hands out each block's displacements ``latency`` exchanges after it was sent.
    """

    latency: int
    break_at: int = 10**9
    nan_at: int = 10**9
    commands: list[float] = field(default_factory=list)
    made_safe: list[float] = field(default_factory=list)
    exchanges: int = 0

    def exchange(self, first_sample, command, displacement_um, measured):
        assert first_sample == len(self.commands)
        if first_sample + command.size > self.break_at:
            raise DeviceError("fake: no answer within 0.1 s")
        self.commands.extend(command.tolist())
        self.exchanges += 1
        first = first_sample - self.latency * command.size
        if first < 0:
            return
        before = [0.0, *self.commands]
        for j in range(command.size):
            played = first + j >= self.nan_at
            displacement_um[j] = np.nan if played else 10.0 * before[first + j]
            measured[j] = before[first + j + 1]

    def make_safe(self, command):
        self.made_safe.append(command)


@dataclass
class FakeClock:
    """Time moves only in sleeps; some of them last longer."""

    now: int = 0
    stall_ns: dict[int, int] = field(default_factory=dict)
    sleeps: int = 0

    def now_ns(self):
        return self.now

    def sleep_until_ns(self, deadline_ns):
        self.now = max(self.now, deadline_ns) + self.stall_ns.get(self.sleeps, 0)
        self.sleeps += 1


@dataclass
class Sink:
    """Keeps copies of all blocks; may be full for a while."""

    full: range = range(0)
    heads: list[tuple[int, ...]] = field(default_factory=list)
    columns: list[np.ndarray] = field(default_factory=list)
    flags: list[np.ndarray] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)

    def push(self, head, state, columns, flags):
        if head[0] in self.full:
            return False
        self.heads.append(head)
        self.columns.append(columns.copy())
        self.flags.append(flags.copy())
        self.states.append(state.copy())
        return True

    def column(self, row):
        return np.concatenate([c[row] for c in self.columns])


@dataclass
class Oversight:
    """Asks for a stop when told to, hands out tunings by sample, and keeps events."""

    stop: object = field(default=lambda: "")
    tunings: dict[int, Tuning] = field(default_factory=dict)
    events: list[LoopEvent] = field(default_factory=list)
    beats: list[int] = field(default_factory=list)
    closed: bool = False

    def beat(self, next_sample):
        self.beats.append(next_sample)
        return self.stop()

    def closing(self):
        self.closed = True

    def tuning(self):
        return self.tunings.pop(self.beats[-1], None)

    def tell(self, event):
        self.events.append(event)


class Bench:
    """One loop with all its parts, to be run once."""

    def __init__(self, reference, *, block=1, device=None, clock=None, sink=None, **options):
        model = options.get("model")
        self.device = device or FakeDevice()
        self.clock = clock or FakeClock()
        self.sink = sink or Sink()
        self.limiter = Limiter(LIMITS, 1.0 / RATE_HZ)
        self.compensator = Compensator(model, RATE_HZ)
        period_ns = 1e9 * block / RATE_HZ
        policy = options.get("policy", "skip")
        self.pacer = Pacer(self.clock, period_ns, policy, 0.5 * period_ns)
        stroke_um = options.get("stroke_um", (-60.0, 60.0))
        rules = {"max_late_ns": 1e9, "keep_all": False, **options.get("rules", {})}
        ahead = options.get("ahead")
        plan = Plan(reference, model is not None, block, ahead=ahead, **rules)
        self.oversight = options.get("oversight") or Oversight(options.get("stop", lambda: ""))
        latency, states = getattr(self.device, "latency", 0), self.compensator.state_size + 1
        self.sent = Batch.empty(latency + 1, block, states)
        self.loop = Loop(
            plan,
            self.device,
            self.compensator,
            self.limiter,
            Interlocks(InterlockLimits(stroke_um=stroke_um), RATE_HZ),
            self.pacer,
            self.clock,
            DelayLine(self.sent),
            self.sink,
            self.oversight,
        )

    def run(self):
        return self.loop.run(1_000_000)


def sine(n=200, amplitude=3.0):
    return amplitude * np.sin(2 * np.pi * 5.0 * np.arange(n) / RATE_HZ)


@pytest.mark.parametrize("block", [1, 7, 50])
def test_waveform_then_ramp(block):
    """Every sample of the waveform is put out, then the ramp ends at the safe value."""
    bench = Bench(sine(230), block=block)
    outcome = bench.run()
    assert (outcome.code, outcome.safe, outcome.dropped) == ("completed", True, 0)
    commands = bench.device.commands
    assert commands[:230] == sine(230).tolist()
    assert commands[-1] == LIMITS.safe
    assert np.abs(np.diff(commands[230:])).max() <= LIMITS.ramp_per_s / RATE_HZ * (1 + 1e-9)
    assert outcome.ended_at == len(commands)


def test_blocks_make_no_difference():
    """The same commands come out whatever the block, hysteresis and limits included."""
    commands = []
    for block in (1, 8, 40):
        bench = Bench(10.0 * sine(400), block=block, model=terfenol_rdpi())
        bench.run()
        commands.append(bench.device.commands[:400])
    assert commands[0] == commands[1] == commands[2]


def test_each_sample_is_recorded_with_what_belongs_to_it():
    """Blocks in the sink are contiguous and hold reference, command and displacement."""
    bench = Bench(10.0 * sine(100), block=10, model=terfenol_rdpi())
    bench.run()
    firsts = [head[0] for head in bench.sink.heads]
    assert firsts == list(range(0, 10 * len(firsts), 10))
    assert bench.sink.column(0)[:100].tolist() == (10.0 * sine(100)).tolist()
    assert np.isnan(bench.sink.column(0)[100:]).all()
    assert bench.sink.column(2).tolist() == bench.device.commands
    flags = np.concatenate(bench.sink.flags)
    assert not (flags[:100] & Flag.RAMP).any()
    assert (flags[100:] & Flag.RAMP).all()


def test_state_before_a_block_is_recorded():
    """From a block's recorded state, its commands can be made again, bit for bit."""
    model = terfenol_rdpi()
    bench = Bench(10.0 * sine(100), block=10, model=model)
    bench.run()
    again = Compensator(model, RATE_HZ)
    again.restore(bench.sink.states[6][:-1])
    wanted = np.empty(10)
    again.process(np.ascontiguousarray(bench.sink.columns[6][0]), wanted)
    assert wanted.tolist() == bench.sink.columns[6][1].tolist()
    assert bench.sink.states[6][-1] == bench.sink.columns[5][2][-1]


@pytest.mark.parametrize("block", [1, 7, 50])
def test_what_is_fed_ahead_is_recorded_beside_the_reference(block):
    """The compensator gets what was prepared for it; the reference is recorded as it was."""
    reference, model = 10.0 * sine(230), terfenol_rdpi()
    ahead = np.concatenate((reference[4:], np.full(4, reference[-1]))) + 0.25
    bench = Bench(reference, block=block, model=model, ahead=ahead)
    assert bench.run().code == "completed"
    assert bench.sink.column(0)[:230].tolist() == reference.tolist()
    assert bench.sink.column(5)[:230].tolist() == ahead.tolist()
    assert np.isnan(bench.sink.column(5)[230:]).all()
    wanted = model.inverse(RATE_HZ).process(ahead.copy())
    assert bench.sink.column(1)[:230].tolist() == wanted.tolist()


def test_tuning_moves_reference_and_what_is_fed_alike():
    """Gain and offset, and the way to them, are the same for both."""
    reference = 10.0 * sine(200)
    ahead = np.concatenate((reference[4:], np.full(4, reference[-1])))
    oversight = Oversight(tunings={40: Tuning(0.5, 0.1, 20)})
    bench = Bench(reference, block=10, model=terfenol_rdpi(), ahead=ahead, oversight=oversight)
    bench.run()
    ramp = np.clip((np.arange(200) - 39) / 20, 0.0, 1.0)
    gains, offsets = 1.0 - 0.5 * ramp, 0.1 * ramp
    np.testing.assert_allclose(bench.sink.column(0)[:200], gains * reference + offsets)
    np.testing.assert_allclose(bench.sink.column(5)[:200], gains * ahead + offsets)


def test_current_runs_record_no_reference():
    """Without a compensator there is no displacement wanted, and none is pretended."""
    bench = Bench(sine(50))
    bench.run()
    assert np.isnan(bench.sink.column(0)).all()


def test_stop_request_ramps_down():
    """A stop leaves by the ramp and says why."""
    asked = iter([""] * 53 + ["stopped by Ctrl-C"] * 1000)
    bench = Bench(np.full(1000, 2.0), stop=lambda: next(asked))
    outcome = bench.run()
    assert (outcome.code, outcome.reason) == ("stopped", "stopped by Ctrl-C")
    assert bench.device.commands[52] == 2.0
    assert bench.device.commands[-1] == 0.0
    assert len(bench.device.commands) == 53 + 20


@pytest.mark.parametrize("block", [1, 10])
def test_lost_sensor_ramps_down(block):
    """A displacement that is not a number ends the run by its way out."""
    bench = Bench(np.full(1000, 2.0), block=block, device=FakeDevice(nan_at=45))
    outcome = bench.run()
    assert outcome.code == "fault"
    assert "displacement nan um at sample 45" in outcome.reason
    assert bench.device.commands[-1] == 0.0
    assert outcome.ended_at <= 45 + block + 30
    flags = np.concatenate(bench.sink.flags)
    assert not (flags[:45] & Flag.SENSOR_INVALID).any()
    assert flags[45] & Flag.SENSOR_INVALID


def test_stroke_limit_ramps_down():
    """A displacement outside the stroke limits ends the run, naming value and limits."""
    bench = Bench(sine(200, 3.0), stroke_um=(-60.0, 25.0))
    outcome = bench.run()
    assert outcome.code == "fault"
    assert "not within the stroke limits -60 to 25 um" in outcome.reason
    assert max(bench.device.commands) < 3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_reference_that_is_not_a_number_ramps_down(bad):
    """A wish that is not finite never reaches the device, and ends the run."""
    reference = np.full(100, 1.5)
    reference[40:] = bad
    bench = Bench(reference, block=5)
    outcome = bench.run()
    assert (outcome.code, outcome.safe) == ("fault", True)
    assert "not a finite number at sample 40" in outcome.reason
    assert np.isfinite(bench.device.commands).all()
    assert bench.device.commands[-1] == 0.0


def test_lost_device_is_made_safe():
    """When exchanges fail there is no ramp: the last resort is used, and the reason kept."""
    bench = Bench(np.full(1000, 2.0), device=FakeDevice(break_at=60))
    outcome = bench.run()
    assert (outcome.code, outcome.safe) == ("fault", True)
    assert outcome.reason == "fake: no answer within 0.1 s"
    assert bench.device.made_safe == [0.0]
    assert outcome.ended_at == 61
    assert [event.code for event in bench.oversight.events] == ["device_lost"]
    assert bench.oversight.closed


def test_sample_that_the_device_did_not_answer_is_recorded():
    """Its command may have reached the device: it is in the recording, without a displacement."""
    bench = Bench(np.full(1000, 2.0), device=FakeDevice(break_at=60))
    bench.run()
    assert bench.sink.column(2).size == 61
    assert np.isnan(bench.sink.column(3)[60])
    assert bench.sink.flags[60][0] & Flag.UNANSWERED
    assert not bench.sink.flags[59][0] & Flag.UNANSWERED


def test_lost_device_that_stays_lost_is_said():
    """Where the safe value can't be confirmed, the outcome says so."""
    bench = Bench(np.full(100, 2.0), device=FakeDevice(break_at=60, safe_works=False))
    outcome = bench.run()
    assert not outcome.safe
    assert "the safe value could not be confirmed: fake: still no answer" in outcome.reason


def test_device_lost_on_the_ramp_keeps_the_first_reason():
    """A second fault on the way out does not hide the first."""
    device = FakeDevice(nan_at=40, break_at=45)
    outcome = Bench(np.full(1000, 2.0), device=device).run()
    assert outcome.reason.startswith("displacement nan um at sample 40")
    assert outcome.reason.endswith("; then fake: no answer within 0.1 s")


def test_very_late_tick_ends_the_run():
    """A stall beyond the limit ends the run by its way out."""
    clock = FakeClock(stall_ns={30: 2_000_000_000})
    bench = Bench(np.full(10_000, 2.0), clock=clock)
    outcome = bench.run()
    assert outcome.code == "fault"
    assert "woke 2.000 s late" in outcome.reason
    assert bench.device.commands[-1] == 0.0


def test_skipped_ticks_are_a_counted_gap():
    """Samples left out by the late policy are counted before the next block, phase kept."""
    clock = FakeClock(stall_ns={30: 5_000_000})
    bench = Bench(sine(200), clock=clock)
    outcome = bench.run()
    gaps = {head[0]: head[2] for head in bench.sink.heads if head[2]}
    assert gaps == {35: 5}
    assert outcome.code == "completed"
    at = [head[0] for head in bench.sink.heads].index(35)
    assert bench.sink.columns[at][1][0] == sine(200)[35]


def test_full_ring_is_a_counted_gap():
    """Blocks that find no room are counted before the next one that does."""
    bench = Bench(sine(200), block=10, sink=Sink(full=range(50, 80)))
    outcome = bench.run()
    gaps = {head[0]: head[2] for head in bench.sink.heads if head[2]}
    assert gaps == {80: 30}
    assert outcome.dropped == 30
    assert len(bench.device.commands) == outcome.ended_at


def test_ticks_record_deadline_lateness_and_exchange():
    """Deadlines count from the start of the run; lateness is what the clock said."""
    clock = FakeClock(stall_ns={3: 120_000})
    bench = Bench(sine(20), clock=clock)
    bench.run()
    assert [head[3] for head in bench.sink.heads[:5]] == [0, 10**6, 2 * 10**6, 3 * 10**6, 4 * 10**6]
    assert [head[4] for head in bench.sink.heads[:5]] == [0, 0, 0, 120_000, 0]


LATENCIES = [1, 3, 8]


@pytest.mark.parametrize("latency", LATENCIES)
def test_displacements_that_come_later_stand_beside_their_commands(latency):
    """With a FIFO between, every sample is recorded once, with its own command's displacement."""
    bench = Bench(sine(230), block=10, device=FifoDevice(latency))
    outcome = bench.run()
    plain = Bench(sine(230), block=10)
    assert (outcome.code, outcome.safe) == ("completed", True)
    assert outcome.ended_at == plain.run().ended_at
    assert [head[:3] for head in bench.sink.heads] == [head[:3] for head in plain.sink.heads]
    for row in (1, 2, 3):
        assert bench.sink.column(row).tolist() == plain.sink.column(row).tolist()
    assert bench.sink.column(4).tolist() == bench.sink.column(2).tolist()
    assert np.concatenate(bench.sink.flags).tolist() == np.concatenate(plain.sink.flags).tolist()


@pytest.mark.parametrize("latency", LATENCIES)
def test_last_blocks_are_waited_for_at_the_safe_value(latency):
    """After the ramp the safe value is held for as many blocks as are under way, and no more."""
    device = FifoDevice(latency)
    outcome = Bench(sine(230), block=10, device=device).run()
    assert len(device.commands) == outcome.ended_at + 10 * latency
    assert set(device.commands[outcome.ended_at :]) == {LIMITS.safe}


def test_state_belongs_to_the_block_it_is_recorded_with():
    """With a FIFO between, a recorded state still makes its block's commands again."""
    model = terfenol_rdpi()
    bench = Bench(10.0 * sine(200), block=10, model=model, device=FifoDevice(4))
    bench.run()
    again = Compensator(model, RATE_HZ)
    again.restore(bench.sink.states[6][:-1])
    wanted = np.empty(10)
    again.process(np.ascontiguousarray(bench.sink.columns[6][0]), wanted)
    assert wanted.tolist() == bench.sink.columns[6][1].tolist()
    assert bench.sink.states[6][-1] == bench.sink.columns[5][2][-1]


@pytest.mark.parametrize("latency", LATENCIES)
@pytest.mark.parametrize("nan_at", [45, 995])
def test_sensor_lost_behind_a_fifo_ramps_down(latency, nan_at):
    """A bad reading ends the run as soon as it comes, even after the waveform's last command."""
    device = FifoDevice(latency, nan_at=nan_at)
    bench = Bench(np.full(1000, 2.0), block=10, device=device)
    outcome = bench.run()
    assert (outcome.code, outcome.safe) == ("fault", True)
    assert f"displacement nan um at sample {nan_at} " in outcome.reason
    assert outcome.ended_at <= nan_at + 10 * latency + 40
    assert device.commands[-1] == LIMITS.safe
    assert bench.sink.column(2).size == outcome.ended_at
    flags = np.concatenate(bench.sink.flags)
    assert not (flags[:nan_at] & Flag.SENSOR_INVALID).any()
    assert (flags[nan_at:] & Flag.SENSOR_INVALID).all()


@pytest.mark.parametrize("break_at", [5, 25, 60, 205, 235])
def test_blocks_under_way_to_a_lost_device_are_recorded(break_at):
    """What was sent and never answered is recorded without displacement, and flagged."""
    device = FifoDevice(3, break_at=break_at)
    bench = Bench(sine(200), block=10, device=device)
    outcome = bench.run()
    assert (outcome.code, outcome.reason) == ("fault", "fake: no answer within 0.1 s")
    assert device.made_safe == [LIMITS.safe]
    recorded = bench.sink.column(2)
    assert recorded.size == outcome.ended_at
    known = min(len(device.commands), recorded.size)
    assert recorded[:known].tolist() == device.commands[:known]
    answered = max(0, 10 * (device.exchanges - 3))
    assert np.isnan(bench.sink.column(3)[answered:]).all()
    assert np.isfinite(bench.sink.column(3)[:answered]).all()
    flags = np.concatenate(bench.sink.flags)
    assert ((flags & Flag.UNANSWERED) != 0).tolist() == [
        k >= answered for k in range(recorded.size)
    ]


def test_full_ring_behind_a_fifo_is_a_counted_gap():
    """Blocks that find no room when their displacements come are counted before the next."""
    device = FifoDevice(3)
    bench = Bench(sine(200), block=10, device=device, sink=Sink(full=range(50, 80)))
    outcome = bench.run()
    assert {head[0]: head[2] for head in bench.sink.heads if head[2]} == {80: 30}
    assert outcome.dropped == 30


@pytest.mark.parametrize("latency", [0, 3])
def test_what_is_on_its_way_can_be_seen_before_it_is_sent(latency):
    """Whoever outlives the loop finds the commands of every exchange that has begun."""
    seen = []

    class Looked(FifoDevice):
        def exchange(self, first_sample, command, displacement_um, measured):
            heads = bench.sent.heads
            row = int(np.argmax(heads[:, Head.SEQUENCE]))
            there = (int(heads[row, Head.FIRST_SAMPLE]), bench.sent.columns[row, 2].tolist())
            seen.append(there == (first_sample, command.tolist()))
            super().exchange(first_sample, command, displacement_um, measured)

    bench = Bench(sine(100), block=10, device=Looked(latency))
    outcome = bench.run()
    assert outcome.ended_at > 100
    assert all(seen[: outcome.ended_at // 10])


def test_loop_gives_a_sign_of_life_in_every_tick():
    """Also on the ramp, where no order is followed any more."""
    oversight = Oversight(lambda: "stopped by a test" if len(oversight.beats) > 20 else "")
    bench = Bench(np.full(1000, 2.0), oversight=oversight)
    outcome = bench.run()
    assert (outcome.code, outcome.reason) == ("stopped", "stopped by a test")
    assert oversight.beats == list(range(outcome.ended_at))


@pytest.mark.parametrize("block", [1, 8])
def test_stop_in_the_ramp_after_the_waveform_changes_nothing(block):
    """A completed waveform stays completed, whatever is asked for on the way to the safe value."""
    n = 4 * block + 3
    oversight = Oversight(lambda: "stopped by a test" if oversight.beats[-1] >= n else "")
    bench = Bench(np.full(n, 2.0), block=block, oversight=oversight)
    outcome = bench.run()
    assert outcome.ended_at > n + block
    assert (outcome.code, outcome.reason) == ("completed", "waveform completed")


def test_tuning_in_the_ramp_after_the_waveform_is_not_taken():
    """What moves nothing is not recorded as a change."""
    oversight = Oversight(tunings={12: Tuning(0.5, 0.0, 1)})
    bench = Bench(np.full(10, 2.0), oversight=oversight)
    assert bench.run().ended_at > 12
    assert oversight.tunings
    assert not oversight.events


def test_invalid_wish_in_the_last_block_is_a_fault():
    """The end of the waveform in the same block does not hide it."""
    reference = np.full(11, 2.0)
    reference[-1] = np.nan
    outcome = Bench(reference, block=8).run()
    assert outcome.code == "fault"
    assert "sample 10" in outcome.reason


def test_reference_is_tuned_without_a_bump():
    """A new gain is reached over its ramp, recorded with the reference, and told once."""
    oversight = Oversight(tunings={40: Tuning(0.5, 0.1, 20)})
    bench = Bench(np.full(200, 2.0), model=terfenol_rdpi(), oversight=oversight)
    bench.run()
    reference = bench.sink.column(0)[:200]
    assert (reference[:40] == 2.0).all()
    assert reference[59:] == pytest.approx(1.1)
    assert np.diff(reference[39:60]) == pytest.approx(-0.9 / 20)
    (event,) = oversight.events
    assert (event.sample, event.code, tuning_samples(event.text)) == (40, "tuned", 20)


def test_many_late_ticks_in_a_row_end_the_run():
    """A machine that can't keep up is not asked to go on."""
    clock = FakeClock(stall_ns=dict.fromkeys(range(50, 80), 700_000))
    bench = Bench(np.full(1000, 2.0), clock=clock, rules={"max_consecutive_late": 5})
    outcome = bench.run()
    assert outcome.code == "fault"
    assert outcome.reason == "5 ticks in a row woke late, up to tick 54"
    assert bench.oversight.events[0].code == "late"


def test_lateness_at_the_start_has_grace():
    """Within the grace late ticks count, but do not end the run."""
    clock = FakeClock(stall_ns={3: 2_000_000_000})
    bench = Bench(np.full(4000, 2.0), clock=clock, rules={"grace_ticks": 2005, "max_late_ns": 1e9})
    assert bench.run().code == "completed"
    assert bench.pacer.counters.late_ticks == 1


def test_recorder_that_does_not_keep_up_ends_the_run():
    """Where everything is to be recorded, the first block without room is the last."""
    bench = Bench(sine(200), block=10, sink=Sink(full=range(50, 60)), rules={"keep_all": True})
    outcome = bench.run()
    assert (outcome.code, outcome.dropped) == ("fault", 10)
    assert outcome.reason == "no room for sample 50: the recorder does not keep up"
