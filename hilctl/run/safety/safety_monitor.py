"""The supervisor's monitor of loop and guardian, which replaces a lost guardian.

The guardian acts by itself if the loop dies or hangs. The supervisor restarts a lost guardian, and
sets the safe values itself if no guardian can: for simulated devices, or if the guardian died,
hangs, or cannot drive the devices. It kills the guardian first, so that only one process holds the
devices. Another guardian then waits: it acts if the supervisor dies, and outputs that are not
confirmed at the end of the run are left to it.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Literal, TypeAlias

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.experiment.preflight import CheckedRun
from hilctl.loop.safe_output import PATIENCE_S
from hilctl.machine.reserve import RESERVE
from hilctl.machine.rt_setup import be_ordinary, be_quick
from hilctl.run.job import safe_priority
from hilctl.run.processes import GuardianProcess, LoopProcess
from hilctl.run.safety.guardian import (
    LAST_CALL_MS,
    GuardedAxis,
    HangWatch,
    SafeAction,
    is_stopped,
)
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import GuardianPhase, PageField, SafeActionResult

_AWAKE_NS = 50_000_000
_LOST_NS = 1_000_000_000
_LOST_LOOKS = 3
_START_NS = 60_000_000_000
_AGAIN_NS = 5_000_000_000
_REPEAT_NS = 500_000_000
_HAND_OVER_S = 10.0
_POLL_S = 0.01


StartGuardian: TypeAlias = Callable[[int | Literal["act"]], GuardianProcess]


class SafetyMonitor:
    """Ensure safe outputs after a loop that died or hangs.

    Args:
        rings: Ring of each axis; the page of the first one is that of the run.
        start_guardian: Starts a guardian that watches a process or, with "act", acts if the
            supervisor does not; None if the run needs no guardian.
    """

    def __init__(
        self,
        checked: CheckedRun,
        rings: Sequence[SampleRing],
        child: LoopProcess,
        start_guardian: StartGuardian | None,
        record_event: Callable[[Event], None],
    ) -> None:
        self._page, self._child = rings[0].page, child
        self._axes, longest_s = list[GuardedAxis](), 0.0
        for each, ring in zip(checked.axes, rings, strict=True):
            loaded, limits = each.loaded, each.loaded.config.command_limits()
            axis = loaded.axis, loaded.device, ring, limits.safe, limits.ramp_per_s
            self._axes.append(GuardedAxis(*axis))
            way = max(limits.high - limits.safe, limits.safe - limits.low)
            longest_s = max(longest_s, way / limits.ramp_per_s)
        self._patience_ns = round(1e9 * (PATIENCE_S + longest_s))
        self._priority = safe_priority(checked.config)
        self._watch = HangWatch(self._page, checked.silence, lambda: is_stopped(child.pid))
        RESERVE.hold(len(rings))
        self._start_guardian, self._record_event = start_guardian, record_event
        self._guardian = start_guardian(child.pid) if start_guardian else None
        self._started_ns: int | None = None
        self._heartbeat_ns, self._looks = 0, 0
        self._trouble_ns = 0
        self._hung = False
        self._action: SafeAction | None = None
        self._acted_ns = 0
        self.result: SafeActionResult | None = None
        """Final result; None while no action was necessary or the action continues."""
        self.by = ""
        """Which process acted."""

    def ready(self) -> bool:
        """Return whether the guardian watches, if the run needs one."""
        guardian = self._guardian
        if guardian is None or guardian.phase == GuardianPhase.WATCHING:
            return True
        if guardian.ended:
            raise RunError(f"the guardian could not be started: {guardian.error}")
        return False

    def update(self, now_ns: int, *, ended: bool) -> None:
        """Check loop and guardian, and act if necessary; never wait for device or guardian."""
        if self.result is not None:
            return
        if self._in_trouble(now_ns, ended=ended):
            self._follow_up(now_ns, ended=ended)
        elif not ended and self._start_guardian is not None:
            self._keep_guardian(now_ns)

    def _in_trouble(self, now_ns: int, *, ended: bool) -> bool:
        hung = not ended and self._watch.hangs(now_ns)
        if self._hung and not hung and not ended and self._reached()[1] is None:
            self._trouble_ns, self._hung = 0, False  # the loop continues, and no process has acted
        if not self._trouble_ns:
            if hung and self._page.ended_safely():
                self._child.kill(0.0)
            elif hung or (ended and not self._page.ended_safely()):
                self._trouble_ns, self._hung = now_ns, hung
        return self._trouble_ns != 0

    def _follow_up(self, now_ns: int, *, ended: bool) -> None:
        """Follow the process that drives the device; drive it here if the guardian does not."""
        action = self._action
        again = action is not None and action.failed and now_ns - self._acted_ns > _REPEAT_NS
        if again or (action is None and not self._guardian_acts(now_ns)):
            self._acted_ns = now_ns
            be_quick(self._priority)
            try:
                self._stand_in()
            finally:
                be_ordinary()
        by, result = self._reached()
        over = now_ns - self._trouble_ns > self._patience_ns
        if over and result is None:
            result = SafeActionResult(self._hung, "unknown", "no process could act", final=False)
        # A loop that was killed in a system call ends later.
        gone = ended or self._action is not None
        # A guardian watches a value that is set but not confirmed.
        settled = result is not None and (result.final or result.output == "set")
        if result is not None and ((settled and gone) or over):
            self.result, self.by = result, by

    def _reached(self) -> tuple[str, SafeActionResult | None]:
        if self._action is not None:
            return "supervisor", self._action.result()
        return "guardian", self._page.safe_result()

    def _stand_in(self) -> None:
        """Drive the devices here, and have a guardian wait."""
        page, guardian = self._page, self._guardian
        page.put(PageField.STANDS_IN, 1)
        # Both before the device is used: neither may write to it afterwards.
        last_call_s = 1e-3 * LAST_CALL_MS
        if guardian is not None and guardian.phase != GuardianPhase.WAITING:
            guardian.kill(last_call_s)
        self._child.kill(last_call_s)
        # The guardian may have finished just before.
        result = page.safe_result()
        if result is not None and result.final:
            return
        if self._action is None:
            prepare = partial(be_quick, self._priority)
            self._action = SafeAction(self._axes, hung=self._hung, prepare=prepare)
        else:
            self._action.retry_failed()
        if self._start_guardian is not None and (guardian is None or guardian.ended):
            with suppress(OSError, MemoryError):  # it is tried again
                self._guardian = self._start_guardian("act")

    def _guardian_acts(self, now_ns: int) -> bool:
        guardian = self._guardian
        if guardian is None or guardian.ended:
            return guardian is not None and guardian.phase == GuardianPhase.DONE
        at_it = guardian.phase in {GuardianPhase.WATCHING, GuardianPhase.ACTING}
        awake = at_it and now_ns - guardian.heartbeat_ns < _AWAKE_NS
        return awake or guardian.phase == GuardianPhase.DONE

    def _keep_guardian(self, now_ns: int) -> None:
        """Replace the guardian if it is lost, and record that."""
        guardian = self._guardian
        if self._started_ns is None:
            self._started_ns = now_ns
        if guardian is not None:
            why = "died" if guardian.ended else self._silent(guardian, now_ns)
            if not why:
                return
            guardian.kill(0.0)
            self._guardian = None
            self._record(f"the guardian {why}; the supervisor watches until another one is ready")
        if now_ns - self._started_ns < _AGAIN_NS and self._heartbeat_ns == 0:
            return  # it has never watched: pause before the next attempt
        assert self._start_guardian is not None
        self._started_ns, self._heartbeat_ns = now_ns, 0
        try:
            self._guardian = self._start_guardian(self._child.pid)
        except OSError as error:
            self._record(f"the guardian cannot be started: {error.strerror}")

    def _silent(self, guardian: GuardianProcess, now_ns: int) -> str:
        """Return how a live guardian is silent, or an empty text."""
        heartbeat_ns = guardian.heartbeat_ns
        if heartbeat_ns != self._heartbeat_ns or heartbeat_ns == 0:
            self._heartbeat_ns, self._looks = heartbeat_ns, 0
            starting = heartbeat_ns == 0 and now_ns - (self._started_ns or now_ns) > _START_NS
            return "does not start" if starting else ""
        # After a stall of the whole computer the guardian gets time to continue.
        self._looks += 1
        lost = self._looks > _LOST_LOOKS and now_ns - heartbeat_ns > _LOST_NS
        return "is silent" if lost else ""

    def _record(self, text: str) -> None:
        sample = self._page.get(PageField.NEXT_SAMPLE)
        self._record_event(Event(sample, "warning", "guardian_lost", text))

    def close(self, stopped: Callable[[], bool] = lambda: False) -> bool:
        """End the guardian, or leave an unconfirmed output to it; return whether it stays."""
        if self.result is None or self.result.final or self._start_guardian is None:
            if self._guardian is not None:
                self._page.put(PageField.RELIEVED, 1)
                self._guardian.end()
            return False
        if self._action is None:
            return self._guardian is not None and not self._guardian.ended
        return self._hand_over(self._action, stopped)

    def _hand_over(self, action: SafeAction, stopped: Callable[[], bool]) -> bool:
        """Hand an unconfirmed output over to the guardian; continue here until that works.

        A stop does not wait for it. Return whether a guardian is active.
        """
        give_up_s = time.monotonic() + _HAND_OVER_S
        while not stopped() and not (action.failed and time.monotonic() > give_up_s):
            guardian = self._guardian
            if guardian is not None and guardian.phase == GuardianPhase.WAITING:
                self._release(action)
                if guardian.await_acting(stopped):
                    return True
            if action.is_over or guardian is None or guardian.ended:
                time.sleep(_REPEAT_NS * 1e-9)
                self._stand_in()
            self.result = action.result(_POLL_S)
            if self.result.final:
                self._page.put(PageField.RELIEVED, 1)
                return False
        self._release(action)
        return self._guardian is not None and not self._guardian.ended

    def _release(self, action: SafeAction) -> None:
        """Stop writing, and leave the device to the guardian that waits for it."""
        action.release_devices()
        self._page.put(PageField.STANDS_IN, 0)
