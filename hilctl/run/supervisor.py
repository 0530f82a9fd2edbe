"""The supervisor: starts the loop process, records what it exchanges, and makes the rig safe.

It holds no device while the loop lives. Should the loop process die or hang, it puts the output at
its safe value by a connection of its own, drains the ring to the last sample, and closes the
recording.
"""

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType

from hilctl.base.errors import DeviceError, InputError, RunError
from hilctl.experiment.check import Checked
from hilctl.loop.plan import Outcome
from hilctl.machine.realtime import be_ordinary
from hilctl.run.change_worker import ChangeWorker
from hilctl.run.child import LoopChild
from hilctl.run.control_socket import ControlServer
from hilctl.run.hang_watch import HangWatch
from hilctl.run.metadata import end_facts
from hilctl.run.recorder import Recorder
from hilctl.run.requests import Requests
from hilctl.run.result import Progress, RunResult
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder, held_devices, run_folder
from hilctl.run.shared_page import Field, PageText, Stop
from hilctl.run.stopping import STOP_SIGNAL
from hilctl.run.systemd import Notifier

_POLL_S = 0.02
_START_DELAY_NS = 50_000_000
_HANG_MARGIN_S = 0.5
_SIGNALS = {
    signal.SIGINT: Stop.CTRL_C,
    signal.SIGTERM: Stop.SIGTERM,
    signal.SIGHUP: Stop.SIGHUP,
    STOP_SIGNAL: Stop.REQUEST,
}


class Supervisor:
    """Runs one checked experiment into one recording.

    Args:
        checked: The experiment.
        output: File to record to.
        overwrite: Whether an existing file may be replaced.
        on_progress: Called with each batch.
    """

    def __init__(
        self,
        checked: Checked,
        output: Path,
        *,
        overwrite: bool,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._checked = checked
        self._config = checked.loaded.config
        self._output = output
        self._overwrite = overwrite
        self._on_progress = on_progress
        self._notifier = Notifier()
        self._stop_signal = 0

    def run(self) -> RunResult:
        """Run to the end.

        Raises:
            InputError: The recording can't be written, or another run holds the device; nothing has
                moved, and no file is left.
            RunError: The loop could not be started; nothing has moved, and no file is left.
        """
        be_ordinary()
        config = self._config
        with ExitStack() as stack:
            # Before anything is held or started: a fork has all that its maker has.
            worker = stack.enter_context(ChangeWorker(self._checked))
            # Before there is a loop: a signal must stop it, not just end this process. And to the
            # last: whoever finds the run's folder may send one.
            stack.enter_context(self._signals())
            # The device before the recording: a run that is refused must not touch a file.
            locks = stack.enter_context(held_devices(self._checked.loaded.device.info.holds))
            recorder = Recorder(self._checked, self._output, overwrite=self._overwrite)
            try:
                folder, own = stack.enter_context(
                    run_folder(config.name, self._output, time.time())
                )
                ring = self._make_ring(folder)
                child = LoopChild(self._checked, folder, ring, locks + own, self._silence_s)
            except BaseException:
                recorder.give_back()
                raise
            self._start(ring, child, recorder)
            self._notifier.say("READY=1", f"STATUS=recording to {self._output}")
            requests = Requests(self._checked, folder, ring.page, recorder, worker)
            started = _StartedRun(self._checked, ring, child, recorder)
            with ControlServer(folder.socket, requests.answer) as server:
                while started.attend(self._stop_signal, self._on_progress):
                    self._notifier.alive()
                    requests.attend()
                    server.serve(_POLL_S)
            self._notifier.say("STOPPING=1")
            return self._result(started.end(self._on_progress), started)

    def _start(self, ring: SampleRing, child: LoopChild, recorder: Recorder) -> None:
        """Wait for the loop to be ready, and give it the start signal."""
        page = ring.page
        try:
            child.await_ready(lambda: self._stop_signal != 0)
            start_ns = time.monotonic_ns() + _START_DELAY_NS
            unix_ns = time.time_ns() + start_ns - time.monotonic_ns()
            recorder.begin(unix_ns, json.loads(page.read_text(PageText.SET_UP)))
        except (RunError, InputError):
            child.kill()  # it waits for the start signal, so nothing has moved
            recorder.give_back()
            raise
        # GO last: the loop then reads its start time, and would take an old heartbeat for silence.
        page.put(Field.SUPERVISOR_HEARTBEAT_NS, time.monotonic_ns())
        page.put(Field.START_NS, start_ns)
        page.put(Field.GO, 1)

    @property
    def _silence_s(self) -> float:
        """Longest that this side may be silent: then half of the ring is full."""
        recording = self._config.recording
        return recording.ring_s / 2.0 if recording.on_failure == "stop" else float("inf")

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(number: int, frame: FrameType | None) -> None:
            self._stop_signal = self._stop_signal or number

        # Never the default, which would end a process that is asked to stop a moment too late.
        signal.signal(STOP_SIGNAL, signal.SIG_IGN)
        before = {number: signal.signal(number, note) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _make_ring(self, folder: RunFolder) -> SampleRing:
        config, info = self._config, self._checked.loaded.device.info
        try:
            return SampleRing.create(
                folder.ring,
                slots=max(16, int(config.recording.ring_s / config.tick_s)),
                block=config.block,
                state_size=self._checked.state_size,
                latency_blocks=info.latency_blocks,
            )
        except OSError as error:
            hint = "less recording.ring_s needs less of it"
            raise RunError(f"{folder.ring}: no memory: {error.strerror}; {hint}") from None

    def _result(self, outcome: Outcome, started: "_StartedRun") -> RunResult:
        recorder = started.recorder
        requested = self._stop_signal == STOP_SIGNAL
        stop_signal = signal.SIGTERM if requested else self._stop_signal
        cut = f"; {recorder.missing} samples are lost: {recorder.error}" if recorder.error else ""
        fault = recorder.error or (outcome.code == "stopped" and not stop_signal)
        code = "fault" if fault else outcome.code
        return RunResult(
            path=self._output,
            code=code,
            reason=outcome.reason + cut,
            safe=outcome.safe,
            stop_signal=stop_signal if code == "stopped" else 0,
            samples=recorder.samples,
            missing=recorder.missing,
            late_ticks=started.ring.page.get(Field.LATE_TICKS),
        )


class _StartedRun:
    """A run whose loop exchanges samples: its ring, its process, its recording."""

    def __init__(
        self,
        checked: Checked,
        ring: SampleRing,
        child: LoopChild,
        recorder: Recorder,
    ) -> None:
        self.ring, self.child, self.recorder = ring, child, recorder
        self._checked = checked
        self._config = checked.loaded.config
        limit_s = self._config.tick_s + self._config.timing.max_late_s + _HANG_MARGIN_S
        self._watch = HangWatch(ring.page, limit_s)
        self._flushed = time.monotonic()
        self._hung = False

    def attend(self, stop_signal: int, on_progress: Callable[[Progress], None]) -> bool:
        """Write the heartbeat, pass a stop on, and record; return whether the loop lives."""
        page = self.ring.page
        # Asked before the ring is drained: of a loop that has ended, nothing can come after that.
        ended = self.child.ended
        page.put(Field.SUPERVISOR_HEARTBEAT_NS, time.monotonic_ns())
        self._pass_stop_on(stop_signal)
        self._drain(on_progress)
        now = time.monotonic()
        if now - self._flushed >= self._config.recording.flush_s:
            # Room is given back only once the file has what stood there.
            self.recorder.flush()
            self.ring.release()
            self._flushed = now
        if not ended and self._watch.hangs(time.monotonic_ns()):
            self._hung = True
            # Before the output is made safe: many devices take one connection only.
            self.child.kill()
        return not ended

    def end(self, on_progress: Callable[[Progress], None]) -> Outcome:
        """Return how the run ended, with the output safe and the recording closed."""
        said = self.child.outcome()
        # The coil comes before the samples: those wait in memory, and lose nothing by it.
        outcome = said if isinstance(said, Outcome) else self._make_safe(said)
        while self.ring.skip_damaged():  # no more will come: take what stands behind damaged blocks
            self._drain(on_progress)
        if outcome is not said:
            if (batch := self.ring.unanswered(self.recorder.next_sample)) is not None:
                self.recorder.batch(batch)
            ended_at = max(self.recorder.next_sample, self.ring.page.get(Field.ENDED_AT))
            outcome = replace(outcome, ended_at=ended_at)
        page = self.ring.page
        facts = end_facts(outcome, page.lateness(), page.get(Field.EVENTS_LOST))
        self.recorder.finish(facts, outcome.ended_at)
        return outcome

    def _make_safe(self, death: str) -> Outcome:
        """Put the output at its safe value in the place of a loop that can't."""
        reason = "the loop process hung, and was killed" if self._hung else death
        safe = True
        try:
            self._checked.loaded.device.make_safe(self._config.safe.value)
        except DeviceError as error:
            reason += f"; the safe value could not be confirmed: {error}"
            safe = False
        return Outcome("fault", reason, 0, safe, 0)

    def _pass_stop_on(self, stop_signal: int) -> None:
        page = self.ring.page
        if stop_signal:
            page.put(Field.STOP, _SIGNALS[signal.Signals(stop_signal)])
        elif self.recorder.error and self._config.recording.on_failure == "stop":
            page.put(Field.STOP, Stop.RECORDER_FAILED)

    def _drain(self, on_progress: Callable[[Progress], None]) -> None:
        page, recorder = self.ring.page, self.recorder
        while (batch := self.ring.pop()) is not None:
            recorder.batch(batch)
            total, late = self._checked.forecast.samples, page.get(Field.LATE_TICKS)
            compensated = self._config.compensator is not None
            on_progress(Progress(recorder.samples, total, late, compensated, batch))
        # After the samples: an event is recorded with those that led to it.
        for event in page.pop_events():
            recorder.event(event)
