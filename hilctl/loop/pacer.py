"""Absolute deadlines, the policy for late ticks, and exact counters of them."""

import ctypes
import errno
import math
import os
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from hilctl.base.device import Clock

LatePolicy: TypeAlias = Literal["skip", "catch_up", "slip", "follow", "spaced"]

USUAL_MISSED_SHARE = 0.01
"""Share of ticks that may be skipped, where no other is given."""

_FOLLOW = 1.0 / 64.0
_FEWEST_STALLS = 5  # one stall, however long, may be an accident; what goes on stalling is none
_TIMER_ABSTIME = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def deadline_misses(skipped: int, due: int, max_share: float) -> str:
    """Return ``deadline misses 944 of 3003 (31 %)`` in words; empty without any.

    Args:
        skipped: Ticks that were left out.
        due: All ticks, with these.
        max_share: Share of them from which on ``timing not kept`` is said too.
    """
    if not skipped:
        return ""
    share = skipped / max(due, 1)
    text = f"deadline misses {skipped} of {due} ({100.0 * share:.2g} %)"
    return f"{text}: timing not kept" if share > max_share else text


class SystemClock:
    """CLOCK_MONOTONIC, with sleeps to an absolute time that don't drift."""

    def __init__(self) -> None:
        self._nanosleep = ctypes.CDLL(None).clock_nanosleep  # returns its error, never sets errno
        self._spec = _Timespec()
        self._pointer = ctypes.byref(self._spec)

    now_ns = staticmethod(time.monotonic_ns)
    """Returns the time in ns."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``; return at once where that is past."""
        if deadline_ns <= self.now_ns():
            return  # the kernel would take as long for it as for any other sleep
        self._spec.tv_sec, self._spec.tv_nsec = divmod(deadline_ns, 1_000_000_000)
        while True:
            code = self._nanosleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, self._pointer, None)
            if code == 0:
                return
            if code != errno.EINTR:
                raise OSError(code, os.strerror(code))


@dataclass(slots=True)
class Lateness:
    """Exact counters of late ticks.

    Attributes:
        late_ticks: Ticks that woke later than the limit after they were due.
        skipped_ticks: Ticks left out to keep the phase.
        worst_ns: Largest lateness.
        worst_tick: Tick that had it.
        longest_run: Most late ticks one after the other.
    """

    late_ticks: int = 0
    skipped_ticks: int = 0
    worst_ns: int = 0
    worst_tick: int = 0
    longest_run: int = 0


@dataclass(frozen=True, slots=True)
class LateRules:
    """From when a tick counts as late, and when lateness ends a run.

    Attributes:
        late_after_ns: Lateness from which a tick counts as late.
        max_late_ns: Lateness that ends the run.
        max_consecutive_late: Late ticks, one after the other, that end the run; 0 for any number.
        grace_ticks: Ticks at the start that no lateness ends the run in.
        missed_window: Last ticks that misses are counted in.
        max_missed: Skipped ticks in that window that are let pass; more of them end the run once
            they come from five stalls or more.
    """

    late_after_ns: float = math.inf
    max_late_ns: float = math.inf
    max_consecutive_late: int = 0
    grace_ticks: int = 0
    missed_window: int = 1
    max_missed: float = math.inf


class Pacer:
    """Wakes the loop at absolute times.

    Args:
        clock: Time.
        period_ns: Time from one tick to the next; it need not be a whole number of ns.
        policy: What happens when a tick wakes a whole period late or more; may be changed between
            ticks. ``follow`` is for devices whose exchange waits for their own clock: there is no
            other wait, and the deadlines follow that clock, so that a late tick is one that came
            later than usual. ``spaced`` is for the start of a run: each tick waits for a whole
            period after the tick before it has ended, and the schedule shifts by what that takes.
            No tick is skipped, and two writes are never less than a period apart, however long an
            exchange took and whenever in it the device moved its output.
        rules: What counts as late.
    """

    def __init__(
        self, clock: "Clock", period_ns: float, policy: LatePolicy, rules: LateRules
    ) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self.policy = policy
        self._rules = rules
        self._origin_ns = 0
        self._stalls: deque[tuple[int, int]] = deque()
        self._missed = 0
        self._not_kept = ""
        self._least_counted_ns = 0.0
        self.late_run = 0
        """Late ticks one after the other, up to this one."""
        self.tick = -1
        self.deadline_ns = 0
        """When the tick under way was due, by the clock."""
        self.late_ns = 0
        """How late the last wait ended; after a skip, behind the first tick that was missed."""
        self.counters = Lateness()

    def begin(self, start_ns: int) -> None:
        """Make the first tick due at ``start_ns``."""
        self._origin_ns = start_ns

    def postpone(self) -> None:
        """Shift the schedule so that the next tick is due a whole period from now, or later."""
        due_ns = self._origin_ns + round((self.tick + 1) * self._period_ns)
        earliest_ns = self._clock.now_ns() + math.ceil(self._period_ns)
        self._origin_ns += max(0, earliest_ns - due_ns)

    def wait(self) -> int:
        """Sleep until the next tick; return how many ticks were skipped before it."""
        if self.policy == "spaced" and self.tick >= 0:
            self.postpone()
        self.tick += 1
        self.deadline_ns = self._origin_ns + round(self.tick * self._period_ns)
        if self.policy == "follow" and self.tick:
            self._follow()
            return 0
        self._clock.sleep_until_ns(self.deadline_ns)
        now_ns = self._clock.now_ns()
        self.late_ns = now_ns - self.deadline_ns
        # Nothing to count, as a rule: late means over a limit, and the worst is soon seen.
        if self.late_ns > self._least_counted_ns or self.late_run:
            self._count()
        if self.late_ns < self._period_ns or self.policy in {"catch_up", "follow", "spaced"}:
            return 0
        if self.policy == "slip":
            self._origin_ns += self.late_ns
            return 0
        skipped = int(self.late_ns / self._period_ns)
        self.tick += skipped
        self.counters.skipped_ticks += skipped
        # The tick that runs now is a later one than that which was waited for.
        self.deadline_ns = self._origin_ns + round(self.tick * self._period_ns)
        self._note_stall(skipped)
        return skipped

    def too_late(self) -> str:
        """Return why the ticks come too late to go on, or an empty text."""
        rules = self._rules
        if self.tick < rules.grace_ticks:
            return ""
        if self.late_ns > rules.max_late_ns:
            return f"tick {self.tick} woke {self.late_ns * 1e-9:.3f} s late, more than the limit"
        if 0 < rules.max_consecutive_late <= self.late_run:
            return f"{self.late_run} ticks in a row woke late, up to tick {self.tick}"
        return self._not_kept

    def _note_stall(self, skipped: int) -> None:
        """Count skipped ticks, and judge those of the last ticks together."""
        rules = self._rules
        if self.tick < rules.grace_ticks:
            return
        self._stalls.append((self.tick, skipped))
        self._missed += skipped
        while self._stalls[0][0] <= self.tick - rules.missed_window:
            self._missed -= self._stalls.popleft()[1]
        if len(self._stalls) >= _FEWEST_STALLS and self._missed > rules.max_missed:
            share = f"{self._missed} deadline misses up to tick {self.tick}"
            allowed = f"more than {rules.max_missed:.4g} in {rules.missed_window} ticks"
            self._not_kept = f"timing not kept: {share}, {allowed}"

    def _follow(self) -> None:
        """Take this moment as the tick: at once where it is early, slowly where it is late."""
        self.late_ns = self._clock.now_ns() - self.deadline_ns
        if self.late_ns < 0:
            self._origin_ns += self.late_ns
            self.deadline_ns += self.late_ns
            self.late_ns = 0
        self._origin_ns += round(self.late_ns * _FOLLOW)
        self._count()

    def _count(self) -> None:
        counters = self.counters
        if self.late_ns > counters.worst_ns:
            counters.worst_ns = self.late_ns
            counters.worst_tick = self.tick
            self._least_counted_ns = min(self.late_ns, self._rules.late_after_ns)
        if self.late_ns > self._rules.late_after_ns:
            counters.late_ticks += 1
            self.late_run += 1
            counters.longest_run = max(counters.longest_run, self.late_run)
        else:
            self.late_run = 0
