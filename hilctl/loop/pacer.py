"""Pacer of the loop: absolute deadlines, policies for late ticks, and exact counters."""

import ctypes
import errno
import math
import os
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from hilctl.base.device import Clock

LatePolicy: TypeAlias = Literal["skip", "catch_up", "follow", "spaced"]

USUAL_MISSED_SHARE = 0.01
"""Default share of ticks that may be skipped."""

_FOLLOW = 1.0 / 64.0
TIMING_REMEDY = "lower sample_rate_hz, or see hilctl doctor"
_FEWEST_STALLS = 5  # a single stall, however long, does not end the run
_TIMER_ABSTIME = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def deadline_misses(skipped: int, due: int, max_share: float) -> str:
    """Return text such as ``deadline misses 944 of 3003 (31 %)``; empty without any.

    ``due`` includes the skipped ticks; above ``max_share`` the text adds ``timing not kept``.
    """
    if not skipped:
        return ""
    share = skipped / max(due, 1)
    text = f"deadline misses {skipped} of {due} ({100.0 * share:.2g} %)"
    return f"{text}: timing not kept" if share > max_share else text


class SystemClock:
    """CLOCK_MONOTONIC with sleeps to an absolute time."""

    def __init__(self) -> None:
        self._nanosleep = ctypes.CDLL(None).clock_nanosleep  # returns its error, sets no errno
        self._spec = _Timespec()
        self._pointer = ctypes.byref(self._spec)

    now_ns = staticmethod(time.monotonic_ns)
    """Return the time in ns."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until a time; return immediately if it has passed."""
        if deadline_ns <= self.now_ns():
            return  # faster than a system call
        self._spec.tv_sec, self._spec.tv_nsec = divmod(deadline_ns, 1_000_000_000)
        while True:
            code = self._nanosleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, self._pointer, None)
            if code == 0:
                return
            if code != errno.EINTR:
                raise OSError(code, os.strerror(code))


@dataclass(slots=True)
class Lateness:
    """Exact counters of late ticks, the most consecutive ones, and the mean lateness of all."""

    late_ticks: int = 0
    skipped_ticks: int = 0
    worst_ns: int = 0
    worst_tick: int = 0
    longest_run: int = 0
    mean_wake_ns: int = 0


@dataclass(frozen=True, slots=True)
class LateRules:
    """When a tick counts as late, and when lateness ends a run.

    Attributes:
        late_after_ns: Smallest lateness that counts as late.
        max_late_ns: Lateness that ends the run.
        max_consecutive_late: Consecutive late ticks that end the run; 0: any number is allowed.
        missed_window: Number of latest ticks in which misses are counted.
        max_missed: Skipped ticks allowed in that window; more ticks end the run if at least five
            stalls caused them.
    """

    late_after_ns: float = math.inf
    max_late_ns: float = math.inf
    max_consecutive_late: int = 0
    missed_window: int = 1
    max_missed: float = math.inf


class Pacer:
    """Wake the loop at absolute times.

    Args:
        period_ns: Period of the ticks; may be fractional.
        policy: Reaction to a tick that is a period or more late; may be changed between ticks.
            ``skip``: skip ticks to keep the phase. ``catch_up``: run all ticks. ``follow``: the
            exchange waits for the device's clock, and the deadlines follow that clock. ``spaced``,
            for the start of a run: each tick waits a whole period after the end of the previous
            tick, so writes are at least a period apart, however long an exchange took.
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
        """Consecutive late ticks up to the present one."""
        self.tick = -1
        self.deadline_ns = 0
        """Deadline of the present tick."""
        self.late_ns = 0
        """Lateness of the last wake-up; after a skip, relative to the first missed tick."""
        self.counters = Lateness()
        self._woke_ns = 0

    @property
    def lateness(self) -> Lateness:
        """The counters and the mean so far."""
        ticks = self.tick + 1 - self.counters.skipped_ticks
        return replace(self.counters, mean_wake_ns=self._woke_ns // max(1, ticks))

    def begin(self, start_ns: int) -> None:
        """Set the time of the first tick."""
        self._origin_ns = start_ns

    def postpone(self) -> None:
        """Shift the schedule so that the next tick is at least a period away."""
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
        self._woke_ns += self.late_ns
        # Usually there is nothing to count.
        if self.late_ns > self._least_counted_ns or self.late_run:
            self._count()
        if self.late_ns < self._period_ns or self.policy in {"catch_up", "follow", "spaced"}:
            return 0
        skipped = int(self.late_ns / self._period_ns)
        self.tick += skipped
        self.counters.skipped_ticks += skipped
        # The present tick is later than the one that was waited for.
        self.deadline_ns = self._origin_ns + round(self.tick * self._period_ns)
        self._note_stall(skipped)
        return skipped

    def too_late(self) -> str:
        """Return why lateness ends the run, or an empty text."""
        rules = self._rules
        if self.late_ns > rules.max_late_ns:
            limit = f"timing.max_late_s ({rules.max_late_ns * 1e-9:g} s)"
            return f"tick {self.tick} woke {self.late_ns * 1e-9:.3f} s late, more than {limit}"
        if 0 < rules.max_consecutive_late <= self.late_run:
            return f"{self.late_run} ticks in a row woke late, up to tick {self.tick}"
        return self._not_kept

    def _note_stall(self, skipped: int) -> None:
        """Count skipped ticks in the window of the last ticks."""
        rules = self._rules
        self._stalls.append((self.tick, skipped))
        self._missed += skipped
        while self._stalls[0][0] <= self.tick - rules.missed_window:
            self._missed -= self._stalls.popleft()[1]
        if len(self._stalls) >= _FEWEST_STALLS and self._missed > rules.max_missed:
            share = f"{self._missed} deadline misses up to tick {self.tick}"
            allowed = f"more than {rules.max_missed:.4g} in {rules.missed_window} ticks"
            self._not_kept = f"timing not kept: {share}, {allowed}: {TIMING_REMEDY}"

    def _follow(self) -> None:
        """Follow the device's clock: adjust immediately if it is early, slowly if it is late."""
        self.late_ns = self._clock.now_ns() - self.deadline_ns
        if self.late_ns < 0:
            self._origin_ns += self.late_ns
            self.deadline_ns += self.late_ns
            self.late_ns = 0
        self._woke_ns += self.late_ns
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
