"""The supervisor's part in making the output safe: it sees to the guardian, and stands in for it.

Whoever finds the loop dead or hanging first is the guardian, which acts by itself. The supervisor
acts where there is none: for a simulated device, and where the guardian has died, is stopped, or
has not started again yet. It kills the guardian first, so that one of them holds the device only.
"""

from collections.abc import Callable
from functools import partial

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.experiment.check import Checked
from hilctl.machine.realtime import be_ordinary, be_quick
from hilctl.run.child import LoopChild
from hilctl.run.guardian import LAST_CALL_MS
from hilctl.run.guardian_process import GuardianProcess, safe_priority, silence_limits
from hilctl.run.hang_watch import HangWatch, is_stopped
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import Field, GuardianPhase, MadeSafe, SharedPage

_AWAKE_NS = 50_000_000
_LOST_NS = 1_000_000_000
_LOST_LOOKS = 3
_START_NS = 60_000_000_000
_AGAIN_NS = 5_000_000_000
_ACTING_NS = 60_000_000_000


class Safety:
    """Sees to it that a loop which died or hangs leaves a safe output.

    Args:
        checked: The experiment.
        page: Shared with loop and guardian.
        child: The loop's process.
        start_guardian: Starts a guardian; None where the run needs none.
        record_event: Records an event.
    """

    def __init__(
        self,
        checked: Checked,
        page: SharedPage,
        child: LoopChild,
        start_guardian: Callable[[], GuardianProcess] | None,
        record_event: Callable[[Event], None],
    ) -> None:
        self._page, self._child = page, child
        self._device = checked.loaded.device
        self._safe_value = checked.loaded.config.safe.value
        self._priority = safe_priority(checked)
        self._watch = HangWatch(page, silence_limits(checked), lambda: is_stopped(child.pid))
        self._start_guardian, self._record_event = start_guardian, record_event
        self._guardian = start_guardian() if start_guardian else None
        self._started_ns: int | None = None
        self._heartbeat_ns, self._looks = 0, 0
        self._trouble_ns = 0
        self._hung = False
        self._action: SafeAction | None = None
        self.made_safe: MadeSafe | None = None
        """What came of making the output safe; None where nobody had to, or it still goes on."""
        self.by = ""
        """Who has made it safe."""

    def ready(self) -> bool:
        """Return whether the guardian watches, where there is one.

        Raises:
            RunError: It could not be started.
        """
        guardian = self._guardian
        if guardian is None or guardian.phase == GuardianPhase.WATCHING:
            return True
        if guardian.ended:
            raise RunError(f"the guardian could not be started: {guardian.error}")
        return False

    def look(self, now_ns: int, *, ended: bool) -> None:
        """Look once, and do what has to be done; never waits for device or guardian.

        Args:
            now_ns: Monotonic time.
            ended: Whether the loop's process was gone before.
        """
        if self.made_safe is not None:
            return
        if self._action is not None:
            self.made_safe, self.by = self._action.result(), "supervisor"
        elif self._in_trouble(now_ns, ended=ended):
            self._see_to_it(now_ns, ended=ended)
        elif not ended and self._start_guardian is not None:
            self._keep_guardian(now_ns)

    def _in_trouble(self, now_ns: int, *, ended: bool) -> bool:
        if not self._trouble_ns:
            hung = not ended and self._watch.hangs(now_ns)
            if hung or (ended and self._page.outcome() is None):
                self._trouble_ns, self._hung = now_ns, hung
        return self._trouble_ns != 0

    def _see_to_it(self, now_ns: int, *, ended: bool) -> None:
        """Leave it to the guardian where that one is at it, or make the output safe here."""
        if ended and (made_safe := self._page.made_safe()) is not None:
            self.made_safe, self.by = made_safe, "guardian"
        elif not self._guardian_acts(now_ns):
            be_quick(self._priority)
            self._stand_in()
            be_ordinary()

    def _stand_in(self) -> None:
        # Both before the device: neither may come back to it.
        last_call_s = 1e-3 * LAST_CALL_MS
        if self._guardian is not None:
            self._guardian.kill(last_call_s)
        self._child.kill(last_call_s)
        # It may have been done in the very last moment.
        self.made_safe, self.by = self._page.made_safe(), "guardian"
        if self.made_safe is None:
            prepare = partial(be_quick, self._priority)
            self._action = SafeAction(
                self._device, self._safe_value, hung=self._hung, prepare=prepare
            )

    def _guardian_acts(self, now_ns: int) -> bool:
        guardian = self._guardian
        if guardian is None or guardian.ended:
            return False
        at_it = guardian.phase in {GuardianPhase.WATCHING, GuardianPhase.ACTING}
        awake = at_it and now_ns - guardian.heartbeat_ns < _AWAKE_NS
        in_time = now_ns - self._trouble_ns <= _ACTING_NS
        return in_time and (awake or guardian.phase == GuardianPhase.DONE)

    def _keep_guardian(self, now_ns: int) -> None:
        """Start another guardian where this one is lost, and say so."""
        guardian = self._guardian
        if self._started_ns is None:
            self._started_ns = now_ns
        if guardian is not None:
            why = "died" if guardian.ended else self._silent(guardian, now_ns)
            if not why:
                return
            guardian.kill()
            self._guardian = None
            self._say(f"the guardian {why}; until there is another one, the supervisor watches")
        if now_ns - self._started_ns < _AGAIN_NS and self._heartbeat_ns == 0:
            return  # it never got as far as to watch: not again and again without a pause
        assert self._start_guardian is not None
        self._started_ns, self._heartbeat_ns = now_ns, 0
        try:
            self._guardian = self._start_guardian()
        except OSError as error:
            self._say(f"the guardian can't be started: {error.strerror}")

    def _silent(self, guardian: GuardianProcess, now_ns: int) -> str:
        """Return how a guardian that lives is silent; empty where it is not."""
        heartbeat_ns = guardian.heartbeat_ns
        if heartbeat_ns != self._heartbeat_ns or heartbeat_ns == 0:
            self._heartbeat_ns, self._looks = heartbeat_ns, 0
            starting = heartbeat_ns == 0 and now_ns - (self._started_ns or now_ns) > _START_NS
            return "does not start" if starting else ""
        # Where all stood still, this side too, it is given the time to go on.
        self._looks += 1
        lost = self._looks > _LOST_LOOKS and now_ns - heartbeat_ns > _LOST_NS
        return "gives no sign any more" if lost else ""

    def _say(self, text: str) -> None:
        sample = self._page.get(Field.NEXT_SAMPLE)
        self._record_event(Event(sample, "warning", "guardian_lost", text))

    def close(self) -> None:
        """End the guardian, whose loop has ended or never started."""
        if self._guardian is not None:
            self._guardian.end()
