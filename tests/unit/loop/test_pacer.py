"""Pacing on absolute deadlines, with a fake clock."""

import errno

import pytest

from hilctl.loop.pacer import LateRules, Pacer, SystemClock, deadline_misses
from tests.fakes import FakeClock

PERIOD_NS = 1_000_000


def pacer(clock, policy="skip"):
    made = Pacer(clock, PERIOD_NS, policy, LateRules(0.5 * PERIOD_NS))  # type: ignore[arg-type]
    made.begin(10_000)
    return made


def test_deadlines_do_not_drift():
    clock = FakeClock(5_000, dict.fromkeys(range(1000), 40_000))
    paced = pacer(clock)
    for tick in range(1000):
        assert paced.wait() == 0
        assert paced.deadline_ns == 10_000 + tick * PERIOD_NS
        assert paced.late_ns == 40_000


def test_period_need_not_be_whole():
    clock = FakeClock(0)
    paced = Pacer(clock, 1000.0 / 3.0, "skip", LateRules(1e9))
    paced.begin(0)
    for _ in range(3001):
        paced.wait()
    assert paced.deadline_ns == 1_000_000


def test_a_late_tick_counts_whether_or_not_it_is_the_worst():
    paced = pacer(FakeClock(5_000, {1: 700_000, 3: 600_000, 5: 300_000, 6: 900_000}))
    seen = []
    for _ in range(8):
        paced.wait()
        counters = paced.counters
        seen.append((counters.late_ticks, counters.worst_ns, counters.worst_tick, paced.late_run))
    worst = 700_000, 1
    assert seen == [
        (0, 0, 0, 0), (1, *worst, 1), (1, *worst, 0), (2, *worst, 1),
        (2, *worst, 0), (2, *worst, 0),
        (3, 900_000, 6, 1), (3, 900_000, 6, 0),
    ]  # fmt: skip


@pytest.mark.parametrize(("late_ns", "counted"), [(499_999, 0), (500_000, 0), (500_001, 1)])
def test_late_is_later_than_the_limit(late_ns, counted):
    paced = pacer(FakeClock(5_000, {3: late_ns}))
    for _ in range(6):
        paced.wait()
    assert paced.counters.late_ticks == counted
    assert paced.counters.worst_ns == late_ns
    assert paced.counters.worst_tick == 3


def test_skipped_ticks_keep_the_phase():
    clock = FakeClock(5_000, {2: 3_200_000})
    paced = pacer(clock)
    assert [paced.wait() for _ in range(4)] == [0, 0, 3, 0]
    assert paced.tick == 6
    assert paced.deadline_ns == 10_000 + 6 * PERIOD_NS
    assert paced.counters.skipped_ticks == 3
    assert paced.lateness.mean_wake_ns == 3_200_000 // 4


@pytest.mark.parametrize("policy", ["skip", "spaced"])
def test_a_spaced_tick_comes_a_period_after_the_one_before_it_ended(policy):
    clock = FakeClock(5_000, {2: 3_200_000})
    paced, woke_ns, ended_ns = pacer(clock, policy), [], []
    for took_ns in (100_000, 0, 300_000, 2_500_000, 0, 0):
        paced.wait()
        woke_ns.append(clock.now)
        clock.now += took_ns
        ended_ns.append(clock.now)
    apart_ns = [woke - ended for woke, ended in zip(woke_ns[1:], ended_ns, strict=False)]
    assert (min(apart_ns) >= PERIOD_NS) == (policy == "spaced")
    assert (paced.tick == 5) == (paced.counters.skipped_ticks == 0) == (policy == "spaced")


def test_a_spaced_schedule_counts_late_wakeups():
    clock = FakeClock(5_000, {2: 3_200_000})
    paced = pacer(clock, "spaced")
    for _ in range(4):
        paced.wait()
        clock.now += 400_000
    assert (paced.counters.late_ticks, paced.counters.worst_ns) == (1, 3_200_000)
    assert (paced.late_ns, paced.deadline_ns) == (0, 10_000 + 3 * 1_400_000 + 3_200_000)


@pytest.mark.parametrize(("now_ns", "due_ns"), [(10_000, 1_010_000), (400_000, 1_400_000)])
def test_a_postponed_tick_is_due_in_a_period(now_ns, due_ns):
    clock = FakeClock(5_000)
    paced = pacer(clock)
    paced.wait()
    clock.now = now_ns
    paced.postpone()
    assert (paced.wait(), paced.deadline_ns) == (0, due_ns)
    assert (paced.wait(), paced.deadline_ns) == (0, due_ns + PERIOD_NS)


class TestMisses:
    def stalled(self, stalls_ns, ticks=400):
        """Run ticks, with stalls by the number of the sleep; return the first reason, its tick."""
        rules = LateRules(missed_window=1000, max_missed=10.0)
        paced = Pacer(FakeClock(0, stalls_ns), PERIOD_NS, "skip", rules)
        paced.begin(0)
        for _ in range(ticks):
            paced.wait()
            if reason := paced.too_late():
                return reason, paced.tick
        return "", paced.tick

    def test_one_long_stall_is_tolerated(self):
        assert self.stalled({3: 900 * PERIOD_NS})[0] == ""

    def test_repeated_misses_end_the_run(self):
        reason, tick = self.stalled(dict.fromkeys(range(400), 125 * PERIOD_NS))
        assert tick == 5 * 126 - 1
        assert reason.startswith(
            "timing not kept: 625 deadline misses up to tick 629, more than 10 in 1000 ticks"
        )

    @pytest.mark.parametrize(("stalls", "ends"), [(10, False), (11, True)])
    def test_the_share_is_of_the_window(self, stalls, ends):
        single = {20 * number: PERIOD_NS for number in range(stalls)}
        assert bool(self.stalled(single)[0]) == ends

    def test_misses_before_the_window_do_not_count(self):
        seldom = {100 * number: PERIOD_NS for number in range(200)}
        assert self.stalled(seldom, ticks=20_000)[0] == ""

    def test_window_counts_no_miss_twice(self):
        seldom = {100 * number: PERIOD_NS for number in range(30)}
        assert self.stalled(seldom | {2950: PERIOD_NS}, ticks=4000)[0]

    @pytest.mark.parametrize(("last", "ends"), [(989, True), (990, False)])
    def test_the_window_is_as_long_as_it_says(self, last, ends):
        """One is skipped for tick 1, nine up to tick 13, the eleventh for tick 1000 or 1001."""
        stalls = {0: PERIOD_NS} | dict.fromkeys((1, 2, 3), 3 * PERIOD_NS) | {last: PERIOD_NS}
        assert bool(self.stalled(stalls, ticks=1100)[0]) == ends


@pytest.mark.parametrize(("skipped", "due", "text"), [
    (0, 3003, ""),
    (30, 3000, "deadline misses 30 of 3000 (1 %)"),
    (944, 3003, "deadline misses 944 of 3003 (31 %): timing not kept"),
    (3, 0, "deadline misses 3 of 0 (3e+02 %): timing not kept"),
])  # fmt: skip
def test_text_of_deadline_misses(skipped, due, text):
    assert deadline_misses(skipped, due, 0.01) == text


def test_catch_up_runs_every_tick():
    clock = FakeClock(5_000, {2: 3_200_000})
    paced = pacer(clock, "catch_up")
    late = []
    for _ in range(8):
        assert paced.wait() == 0
        late.append(paced.late_ns)
    assert late == [0, 0, 3_200_000, 2_200_000, 1_200_000, 200_000, 0, 0]
    assert paced.tick == 7
    assert paced.counters.longest_run == 3


def test_system_clock_sleeps_to_a_deadline():
    clock = SystemClock()
    deadline_ns = clock.now_ns() + 2_000_000
    clock.sleep_until_ns(deadline_ns)
    assert clock.now_ns() >= deadline_ns
    clock.sleep_until_ns(deadline_ns)


def test_sleep_that_a_signal_interrupts_goes_on(monkeypatch):
    clock, codes, deadlines = SystemClock(), [errno.EINTR, errno.EINTR, 0], []

    def nanosleep(kind, flags, spec, left):
        deadlines.append((spec._obj.tv_sec, spec._obj.tv_nsec))
        return codes.pop(0)

    clock._nanosleep = nanosleep
    monkeypatch.setattr(clock, "now_ns", lambda: 2_000_000_000)
    clock.sleep_until_ns(3_000_000_007)
    assert deadlines == [(3, 7)] * 3
    codes.append(errno.EINVAL)
    with pytest.raises(OSError, match="Invalid argument") as caught:
        clock.sleep_until_ns(2_000_000_001)
    assert caught.value.errno == errno.EINVAL


class TestTooLate:
    def paced(self, stalls_ns, ticks, **rules):
        """Return a pacer after a number of ticks, with the named stalls."""
        rules = LateRules(late_after_ns=0.5 * PERIOD_NS, **rules)
        made = Pacer(FakeClock(0, stalls_ns), PERIOD_NS, "catch_up", rules)
        made.begin(0)
        for _ in range(ticks):
            made.wait()
        return made

    def test_without_a_rule_no_lateness_ends_a_run(self):
        paced = self.paced({0: 100 * PERIOD_NS}, 90)
        assert paced.late_run == 90
        assert paced.too_late() == ""

    @pytest.mark.parametrize(("beyond_ns", "ends"), [(0, False), (1, True)])
    def test_one_tick_beyond_the_limit_ends_it(self, beyond_ns, ends):
        paced = self.paced({2: 1_250_000_000 + beyond_ns}, 3, max_late_ns=1_250_000_000)
        said = "tick 2 woke 1.250 s late, more than timing.max_late_s (1.25 s)"
        assert paced.too_late() == (said if ends else "")

    @pytest.mark.parametrize(("ticks", "ends"), [(5, False), (6, True)])
    def test_consecutive_late_ticks_end_the_run(self, ticks, ends):
        stalls_ns = {0: PERIOD_NS, 3: 100 * PERIOD_NS}
        paced = self.paced(stalls_ns, ticks, max_consecutive_late=3)
        assert paced.too_late() == ("3 ticks in a row woke late, up to tick 5" if ends else "")
        assert paced.counters.longest_run == ticks - 3


class TestFollow:
    def run(self, clock, exchange_ns, ticks):
        """Let exchanges take a time each; return the pacer and each tick's lateness."""
        paced = pacer(clock, "follow")
        late_ns = []
        for tick in range(ticks):
            assert paced.wait() == 0
            late_ns.append(paced.late_ns)
            clock.now += exchange_ns(tick)
        return paced, late_ns

    def test_following_pacer_waits_only_for_the_start(self):
        clock = FakeClock(5_000)
        self.run(clock, lambda _: PERIOD_NS, 100)
        assert clock.sleeps == 1
        assert clock.now == 10_000 + 100 * PERIOD_NS

    @pytest.mark.parametrize("ppm", [-500, 500])
    def test_a_clock_that_drifts_is_never_late(self, ppm):
        period = PERIOD_NS + PERIOD_NS * ppm // 1_000_000
        paced, late_ns = self.run(FakeClock(5_000), lambda _: period, 100_000)
        assert paced.counters.late_ticks == 0
        assert max(late_ns) < 0.1 * PERIOD_NS

    def test_a_burst_that_fills_the_fifo_is_not_lateness(self):
        burst = 8
        paced, late_ns = self.run(FakeClock(5_000), lambda k: PERIOD_NS if k >= burst else 0, 100)
        assert max(late_ns) == min(late_ns) == 0
        assert paced.deadline_ns == 10_000 + (100 - 1 - burst) * PERIOD_NS
        assert paced.counters.late_ticks == 0

    def test_each_tick_of_a_burst_is_due_when_it_comes(self):
        clock = FakeClock(5_000)
        paced = pacer(clock, "follow")
        for _ in range(8):
            paced.wait()
            assert (paced.deadline_ns, paced.late_ns) == (clock.now, 0)
        clock.now += 3 * PERIOD_NS
        paced.wait()
        assert paced.late_ns == 2 * PERIOD_NS

    def test_deadlines_follow_by_a_64th_of_the_lateness(self):
        clock = FakeClock(5_000)
        paced = pacer(clock, "follow")
        paced.wait()
        clock.now += PERIOD_NS + 6_400
        paced.wait()
        assert (paced.deadline_ns, paced.late_ns) == (10_000 + PERIOD_NS, 6_400)
        clock.now += PERIOD_NS
        paced.wait()
        assert (paced.deadline_ns, paced.late_ns) == (10_100 + 2 * PERIOD_NS, 6_300)

    def test_a_stall_is_late_and_soon_forgotten(self):

        def exchange_ns(tick):
            return {50: 6 * PERIOD_NS}.get(tick, 0 if 51 <= tick < 56 else PERIOD_NS)

        paced, late_ns = self.run(FakeClock(5_000), exchange_ns, 200)
        assert late_ns[51] == 5 * PERIOD_NS
        assert late_ns[51:57] == sorted(late_ns[51:57], reverse=True)
        assert max(late_ns[57:]) < 0.5 * PERIOD_NS
        assert 5 <= paced.counters.late_ticks <= 6
