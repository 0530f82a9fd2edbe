"""The supervisor's part in making the output safe: it sees to the guardian, and stands in for it.

Whoever finds the loop dead or hanging first is the guardian, which acts by itself. The supervisor
acts where there is none: for a simulated device, and where the guardian has died, is stopped, or
has not started again yet. It kills the guardian first, so that one of them holds the device only.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.experiment.check import Checked
from hilctl.machine.realtime import be_ordinary, be_quick
from hilctl.run.child import LoopChild
from hilctl.run.guardian import LAST_CALL_MS, GuardianJob
from hilctl.run.hang_watch import HangWatch, SilenceLimits, is_stopped
from hilctl.run.run_folder import RunFolder
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import Field, GuardianPhase, MadeSafe, PageText, SharedPage

_AWAKE_NS = 50_000_000
_LOST_NS = 1_000_000_000
_LOST_LOOKS = 3
_START_NS = 60_000_000_000
_AGAIN_NS = 5_000_000_000
_ACTING_NS = 60_000_000_000
_END_S = 1.0
_SIMULATED_MARGIN_S = 0.5
_HANG_S = 0.08
_STOPPED_S = 0.02


def silence_limits(checked: Checked) -> SilenceLimits:
    """Return how long the loop of an experiment may be silent."""
    config = checked.loaded.config
    timing = config.timing
    simulated = checked.loaded.device.info.simulated
    hang_s = timing.hang_s
    if hang_s is None:
        hang_s = timing.max_late_s + _SIMULATED_MARGIN_S if simulated else _HANG_S
    periods_s = 2.0 * config.tick_s
    return SilenceLimits(
        loop_s=periods_s + hang_s,
        # A device that takes longer makes the next tick too late, which ends the run as well.
        exchange_s=timing.max_late_s,
        # Without a coil to protect, who stops a loop may be looking into it with a debugger.
        stopped_s=periods_s + (hang_s if simulated else min(hang_s, _STOPPED_S)),
    )


def _priority(checked: Checked) -> int:
    """Return the SCHED_FIFO priority of whoever makes the output safe.

    Above the loop: one that runs wild at its own priority must not keep that waiting.
    """
    return checked.loaded.config.realtime.priority + 1


class GuardianProcess:
    """The guardian of one run; see :mod:`hilctl.run.guardian`.

    Args:
        job: What it guards.
        folder: The run's folder.
        page: Shared with it.
        inherits: Descriptors of locks that it is to hold.

    Raises:
        OSError: It can't be started.
    """

    def __init__(
        self, job: GuardianJob, folder: RunFolder, page: SharedPage, inherits: Sequence[int]
    ) -> None:
        self._page = page
        # A file and not a pipe: a pipe could keep the supervisor waiting.
        folder.guardian_job.write_text(job.to_json(), encoding="utf-8")
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.STARTING)
        page.put(Field.GUARDIAN_HEARTBEAT_NS, 0)
        loop = os.pidfd_open(job.loop)
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "hilctl.run.guardian"),
                    *(str(folder.guardian_job), str(loop)),
                ],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                pass_fds=(*inherits, loop),
            )
        finally:
            os.close(loop)

    @property
    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    @property
    def phase(self) -> GuardianPhase:
        """How far it has come."""
        return GuardianPhase(self._page.get(Field.GUARDIAN_PHASE))

    @property
    def heartbeat_ns(self) -> int:
        """When it gave a sign last, monotonic time; 0 where it never did."""
        return self._page.get(Field.GUARDIAN_HEARTBEAT_NS)

    @property
    def error(self) -> str:
        """Why it could not start."""
        return self._page.read_text(PageText.GUARDIAN) or "it died"

    def kill(self, wait_s: float | None = None) -> None:
        """End it at once.

        Args:
            wait_s: Longest wait until it is gone; None for as long as that takes.
        """
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)

    def end(self) -> None:
        """Let it end by itself, as it does once the loop has; not for long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
            return
        self.kill()


def guardian_of(
    checked: Checked, folder: RunFolder, page: SharedPage, loop: int, inherits: Sequence[int]
) -> Callable[[], GuardianProcess]:
    """Return what starts the guardian of a run, any number of times.

    Args:
        checked: The experiment.
        folder: The run's folder, with its ring.
        page: The ring's page.
        loop: Process number of the loop.
        inherits: Descriptors of locks that the guardian is to hold.
    """
    loaded = checked.loaded
    job = GuardianJob(
        experiment=loaded.yaml_text,
        files=loaded.files.texts,
        folder=str(loaded.folder.resolve()),
        ring=str(folder.ring),
        safe_value=loaded.config.safe.value,
        limits=silence_limits(checked),
        loop=loop,
        priority=_priority(checked),
    )
    return lambda: GuardianProcess(job, folder, page, inherits)


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
        self._priority = _priority(checked)
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
        if guardian is None or guardian.ended or now_ns - self._trouble_ns > _ACTING_NS:
            return False
        if guardian.phase == GuardianPhase.DONE:
            return True
        at_it = guardian.phase in {GuardianPhase.WATCHING, GuardianPhase.ACTING}
        return at_it and now_ns - guardian.heartbeat_ns < _AWAKE_NS

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
