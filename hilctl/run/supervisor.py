"""The supervisor: starts the loop process, records what it exchanges, and makes the rig safe.

It holds no device while the loop lives. Should the loop process die or hang, it drains the ring to
the last sample, puts the output at its safe value by a connection of its own, and closes the
recording.
"""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from hilctl.base.errors import DeviceError, InputError, RunError
from hilctl.experiment.check import Checked
from hilctl.loop.compensator import Compensator
from hilctl.loop.plan import Outcome
from hilctl.machine.realtime import be_ordinary
from hilctl.run.child import LoopChild
from hilctl.run.control_socket import ControlServer
from hilctl.run.hang_watch import HangWatch
from hilctl.run.metadata import shared_end_facts
from hilctl.run.recorder import Recorder
from hilctl.run.requests import Orders
from hilctl.run.result import Progress, RunResult
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder, held_devices, run_folder
from hilctl.run.shared_page import Field
from hilctl.run.systemd import Notifier

_POLL_S = 0.02
_START_DELAY_NS = 50_000_000
_HANG_MARGIN_S = 0.5
_SIGNALS = {signal.SIGINT: 1, signal.SIGTERM: 2, signal.SIGHUP: 3}
_RECORDER_FAILED = 4
_STOP_ORDER = 5


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
            user = f"run {config.name} (process {os.getpid()}, recording {self._output})"
            locks = stack.enter_context(held_devices(self._checked.loaded.device.info.holds, user))
            recorder = Recorder(self._checked, self._output, overwrite=self._overwrite)
            try:
                folder, own = stack.enter_context(
                    run_folder(config.name, self._output, time.time())
                )
                stack.enter_context(self._signals())
                ring = self._make_ring(folder)
                child = LoopChild(self._checked, folder, ring, locks + own, self._silence_s)
            except BaseException:
                recorder.give_back()
                raise
            try:
                child.await_ready(lambda: self._stop_signal != 0)
                start_ns = time.monotonic_ns() + _START_DELAY_NS
                started = time.time_ns() + start_ns - time.monotonic_ns()
                recorder.begin(started, json.loads(ring.read_text()))
            except (RunError, InputError):
                child.kill()  # it waits for the word to start, so nothing has moved
                recorder.give_back()
                raise
            ring.put(Field.SUPERVISOR_BEAT_NS, time.monotonic_ns())
            ring.put(Field.START_NS, start_ns)
            ring.put(Field.GO, 1)
            self._notifier.say("READY=1", f"STATUS=recording to {self._output}")
            orders = Orders(self._checked, folder, ring, recorder)
            with ControlServer(folder.socket, orders.answer) as server:
                hung = self._drain_while_alive(ring, child, recorder, server, orders)
            self._notifier.say("STOPPING=1")
            outcome = self._outcome(ring, child, recorder, hung)
            recorder.finish(shared_end_facts(outcome, ring), outcome.ended_at)
            return self._result(outcome, ring, recorder, ordered=orders.stop)

    @property
    def _silence_s(self) -> float:
        """Longest that this side may be silent: then half of the ring is full."""
        recording = self._config.recording
        return recording.ring_s / 2.0 if recording.on_failure == "stop" else float("inf")

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(number: int, frame: FrameType | None) -> None:
            self._stop_signal = self._stop_signal or number

        before = {number: signal.signal(number, note) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _make_ring(self, folder: RunFolder) -> SampleRing:
        config, info = self._config, self._checked.loaded.device.info
        slots = max(16, int(config.recording.ring_s / config.tick_s))
        state = Compensator(self._checked.loaded.model, config.sample_rate_hz).state_size + 1
        try:
            return SampleRing.create(
                folder.ring,
                slots=slots,
                block=config.block,
                state_size=state,
                in_flight=info.latency_blocks + 1,
            )
        except OSError as error:
            hint = "less recording.ring_s needs less of it"
            raise RunError(f"{folder.ring}: no memory: {error.strerror}; {hint}") from None

    def _drain_while_alive(
        self,
        ring: SampleRing,
        child: LoopChild,
        recorder: Recorder,
        server: ControlServer,
        orders: Orders,
    ) -> bool:
        """Record until the loop is gone; return whether it hung and had to be killed."""
        limit_s = self._config.tick_s + self._config.timing.max_late_s + _HANG_MARGIN_S
        watch = HangWatch(ring, limit_s)
        flushed = time.monotonic()
        hung = False
        while True:
            ended = child.ended
            ring.put(Field.SUPERVISOR_BEAT_NS, time.monotonic_ns())
            self._order_stop(ring, recorder, orders)
            self._drain(ring, recorder)
            now = time.monotonic()
            if now - flushed >= self._config.recording.flush_s:
                recorder.flush()
                ring.release()
                flushed = now
            if ended:
                return hung
            if watch.hangs(time.monotonic_ns()):
                hung = True
                child.kill()
            self._notifier.alive()
            server.serve(_POLL_S)

    def _order_stop(self, ring: SampleRing, recorder: Recorder, orders: Orders) -> None:
        if self._stop_signal:
            ring.put(Field.STOP, _SIGNALS[signal.Signals(self._stop_signal)])
        elif orders.stop:
            ring.put(Field.STOP, _STOP_ORDER)
        elif recorder.error and self._config.recording.on_failure == "stop":
            ring.put(Field.STOP, _RECORDER_FAILED)

    def _drain(self, ring: SampleRing, recorder: Recorder) -> None:
        while (batch := ring.pop()) is not None:
            recorder.batch(batch)
            total, late = self._checked.forecast.samples, ring.get(Field.LATE_TICKS)
            self._on_progress(Progress(recorder.samples, total, late, batch))
        for event in ring.pop_events():
            recorder.event(event)

    def _outcome(
        self, ring: SampleRing, child: LoopChild, recorder: Recorder, hung: bool
    ) -> Outcome:
        said = child.outcome()
        if isinstance(said, Outcome):
            self._salvage(ring, recorder)
            return said
        reason = "the loop process hung, and was killed" if hung else said
        safe = True
        try:
            self._checked.loaded.device.make_safe(self._config.safe.value)
        except DeviceError as error:
            reason += f"; the safe value could not be confirmed: {error}"
            safe = False
        self._salvage(ring, recorder)
        if (batch := ring.unanswered(recorder.next_sample)) is not None:
            recorder.batch(batch)
        return Outcome("fault", reason, recorder.next_sample, safe, 0)

    def _salvage(self, ring: SampleRing, recorder: Recorder) -> None:
        """Take what stands behind damaged blocks, now that no more will come."""
        while ring.skip_damaged():
            self._drain(ring, recorder)

    def _result(
        self, outcome: Outcome, ring: SampleRing, recorder: Recorder, *, ordered: bool
    ) -> RunResult:
        stop_signal = self._stop_signal or (signal.SIGTERM if ordered else 0)
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
            late_ticks=ring.get(Field.LATE_TICKS),
        )
