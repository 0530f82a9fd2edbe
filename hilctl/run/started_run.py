"""A run whose loop exchanges samples, as the supervisor's main thread sees to it.

That thread writes the heartbeat, passes stops on, and watches over the coil. It does no file
input or output, and waits for nobody who does.
"""

import signal
import time
from dataclasses import replace

from hilctl.base.events import Event
from hilctl.experiment.check import Checked
from hilctl.loop.plan import Outcome
from hilctl.loop.safe_output import describe
from hilctl.run.child import LoopProcess
from hilctl.run.result import Progress
from hilctl.run.ring import SampleRing
from hilctl.run.ring_recorder import RingRecorder
from hilctl.run.safety import Safety
from hilctl.run.shared_page import Field, Stop
from hilctl.run.stopping import HANG_UP, STOP_SIGNAL

STOPS = {
    signal.SIGINT: Stop.CTRL_C,
    signal.SIGTERM: Stop.SIGTERM,
    HANG_UP: Stop.SIGHUP,
    STOP_SIGNAL: Stop.REQUEST,
}


class StartedRun:
    """A run from its start signal to the closed recording.

    Args:
        checked: The experiment.
        ring: Its ring.
        child: Its loop.
        safety: Who sees to a safe output.
        recording: Takes what the loop exchanges.
    """

    def __init__(
        self,
        checked: Checked,
        ring: SampleRing,
        child: LoopProcess,
        safety: Safety,
        recording: RingRecorder,
    ) -> None:
        self._config, self._forecast = checked.loaded.config, checked.forecast
        self._page, self._child = ring.page, child
        self._safety, self._recording = safety, recording
        self.outcome: Outcome | None = None
        """How it ended, with the output safe as far as that can be had; None before."""
        self.broke = ""
        """What went wrong in the supervisor itself; empty where nothing did."""

    def attend(self, stop_signal: int) -> bool:
        """Write the heartbeat, pass stops on, see to a safe output; return whether it goes on.

        Args:
            stop_signal: Number of the signal that is to stop the run, or 0.
        """
        # Asked first: of a loop that has ended, nothing can come after that.
        ended = self._child.ended
        now_ns = time.monotonic_ns()
        self._page.put(Field.SUPERVISOR_HEARTBEAT_NS, now_ns)
        self._pass_stop_on(stop_signal)
        if self.outcome is None:
            self._safety.update(now_ns, ended=ended)
            # The coil comes before the samples: those wait in memory, and lose nothing by it.
            self._conclude(ended=ended)
        return not self._recording.finished

    def break_off(self, error: Exception) -> None:
        """Have the loop stop by its safe ramp, as something is wrong with the supervisor."""
        self.broke = self.broke or f"{type(error).__name__}: {error}"
        text = f"the supervisor broke: {self.broke}"
        sample = self._page.get(Field.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "error", "supervisor_broke", text))

    def progress(self) -> Progress | None:
        """Return where it stands; None before the first sample."""
        if (newest := self._recording.newest) is None:
            return None
        return Progress(
            samples=self._recording.recorder.samples,
            total=self._forecast.samples,
            late_ticks=self._page.get(Field.LATE_TICKS),
            compensated=self._config.compensator is not None,
            batch=newest,
        )

    def progress_failed(self, text: str) -> None:
        """Record that nobody sees the progress any more."""
        sample = self._page.get(Field.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "warning", "progress_failed", text))

    def _conclude(self, *, ended: bool) -> None:
        result, said = self._safety.result, self._page.outcome() if ended else None
        if result is None:
            # Without a safe end, somebody is still to act.
            self.outcome = said if self._page.ended_safely() else None
        else:
            hung = "the loop process hung, and was killed"
            reason = hung if result.hung else said.reason if said else self._child.death()
            if self._safety.by == "guardian" and result.confirmed:
                reason += "; the guardian set the output to its safe value"
            if not result.confirmed:
                reason += f"; {describe(result.output, result.error)}"
            last = said or Outcome("fault", "", 0, "unknown", 0)
            self.outcome = replace(last, code="fault", reason=reason, output=result.output)
        if self.outcome is not None:
            self._recording.end(self.outcome, lost_loop=result is not None and said is None)

    def _pass_stop_on(self, stop_signal: int) -> None:
        page = self._page
        must_record = self._config.recording.on_failure == "stop"
        if stop_signal:
            page.put(Field.STOP, STOPS[signal.Signals(stop_signal)])
        elif self.broke:
            page.put(Field.STOP, Stop.SUPERVISOR_BROKE)
        elif must_record and self._recording.stalled_s() > self._config.recording.ring_s / 2.0:
            # Not at the first error: until the ring is half full, nothing is lost by a retry.
            failed = bool(self._recording.recorder.error)
            page.put(Field.STOP, Stop.RECORDER_FAILED if failed else Stop.RECORDER_STALLED)
