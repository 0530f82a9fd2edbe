"""The supervisor: starts loop, guardian and recorder, and monitors the run to its end.

Everything that can fail happens before the start signal. Afterwards recording, ring and safe value
are served even if another part of the supervisor fails.
"""

import json
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import FrameType

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.base.formatting import encodable
from hilctl.experiment.preflight import CheckedRun
from hilctl.loop.pacer import deadline_misses
from hilctl.loop.safe_output import LoopOutcome, describe
from hilctl.machine.rt_setup import be_ordinary, favoured
from hilctl.machine.suspend import SUSPEND_REMEDY, SuspendDetector, SuspendInhibitor
from hilctl.run.control.client import HANG_UP, JOB_CONTROL, STOP_SIGNAL
from hilctl.run.control.requests import ControlServer, Requests
from hilctl.run.job import Job
from hilctl.run.metadata import RunDescription
from hilctl.run.processes import GuardianProcess, GuardianRelief, LoopProcess
from hilctl.run.recorder import Recorder, RingRecorder, discard_all, recorders_of, result_of
from hilctl.run.result import Progress, RunResult, recordings_of
from hilctl.run.run_folder import DeviceLocks, OutputPlace, RunFolder, run_folder
from hilctl.run.safety.safety_monitor import SafetyMonitor
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, SharedPage, Stop

_log = logging.getLogger(__name__)

_POLL_S = 0.01
_SHOWN_EVERY_S = 0.05
_LAST_SHOWN_S = 0.5
_START_DELAY_NS = 50_000_000
_START_TRIES = 10
_GUARDIAN_READY_S = 60.0
STOPS = {
    signal.SIGINT: Stop.CTRL_C,
    signal.SIGTERM: Stop.SIGTERM,
    HANG_UP: Stop.SIGHUP,
    STOP_SIGNAL: Stop.REQUEST,
}


class SystemdNotifier:
    """Notify systemd of readiness, watchdog and stop with sd_notify(3)."""

    def __init__(
        self,
        environment: Mapping[str, str] = os.environ,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._clock = clock
        self._next_s = clock()
        try:
            self._every_s = int(environment.get("WATCHDOG_USEC", "0")) * 1e-6 / 3.0
        except ValueError:
            self._every_s = 0.0

    def say(self, *lines: str) -> None:
        """Send lines such as ``READY=1``; ignore lines that cannot be sent."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto(encodable("\n".join(lines)).encode(), self._address)

    def alive(self) -> None:
        """Feed the watchdog three times per interval; call this more often."""
        if self._every_s and self._clock() >= self._next_s:
            self._next_s = self._clock() + self._every_s
            self.say("WATCHDOG=1")


class ProgressThread:
    """Report progress in a thread, so that a blocked terminal does not delay the run."""

    def __init__(
        self,
        current: Callable[[], Progress | None],
        on_progress: Callable[[Progress], None],
        on_error: Callable[[str], None],
    ) -> None:
        self._current, self._on_progress, self._on_error = current, on_progress, on_error
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="progress", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """Report a last time; wait only briefly for a blocked terminal."""
        self._ending.set()
        self._thread.join(_LAST_SHOWN_S)

    def _run(self) -> None:
        try:
            while not self._ending.wait(_SHOWN_EVERY_S):
                self._show()
            self._show()
        except Exception as error:  # noqa: BLE001  an error of the display must not end the run
            self._on_error(f"progress is no longer reported: {type(error).__name__}: {error}")

    def _show(self) -> None:
        if (progress := self._current()) is not None:
            self._on_progress(progress)


class RunMonitor:
    """Watch a run from the supervisor's main thread: heartbeat, stop requests, outcome.

    It covers the time from the start signal to the closed recording, performs no file access, and
    never waits for a thread that does.
    """

    def __init__(
        self,
        checked: CheckedRun,
        page: SharedPage,
        child: LoopProcess,
        safety: SafetyMonitor,
        recording: RingRecorder,
        suspend: SuspendDetector,
    ) -> None:
        self._config, self._forecast = checked.config, checked.first.forecast
        self._page, self._child = page, child
        self._safety, self._recording = safety, recording
        self._suspend, self._suspended = suspend, False
        self.outcome: LoopOutcome | None = None
        """Outcome of the run; None until the output is safe or nothing more can be done."""
        self.broke = ""
        """Error of the supervisor itself; may be empty."""
        self._simulated = checked.simulated
        self._timeouts = ", ".join(
            f"device.timeout_s{' of ' * bool(name)}{name} is "
            f"{each.loaded.config.device.get('timeout_s', 'not set')}"
            for name, each in zip(checked.names, checked.axes, strict=True)
        )
        self._ended, self._silent_ns = False, 0  # from the last heartbeat of the loop to its end

    def poll(self, stop_signal: int) -> bool:
        """Write the heartbeat, pass stops on, update safety; return whether the run is active."""
        # First: after its end a loop writes nothing more to the page.
        ended = self._child.ended
        now_ns = time.monotonic_ns()
        self._page.put(PageField.SUPERVISOR_HEARTBEAT_NS, now_ns)
        self._pass_stop_on(stop_signal)
        if not self._ended:
            heartbeat_ns = self._page.get(PageField.LOOP_HEARTBEAT_NS)
            self._ended, self._silent_ns = ended, now_ns - heartbeat_ns
        if self.outcome is None:
            self._safety.update(now_ns, ended=ended)
            # The safe value before the samples, which are safe in memory.
            self._conclude(ended=ended)
        return not self._recording.finished

    def break_off(self, error: Exception) -> None:
        """Stop the loop by its safe ramp because the supervisor failed."""
        self.broke = self.broke or f"{type(error).__name__}: {error}"
        text = f"the supervisor broke: {self.broke}"
        sample = self._page.get(PageField.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "error", "supervisor_broke", text))

    def progress(self) -> Progress | None:
        """Return the progress; None before the first sample."""
        if (newest := self._recording.newest) is None:
            return None
        return Progress(
            samples=self._recording.recorders[0].samples,
            total=self._forecast.samples,
            late_ticks=self._page.get(PageField.LATE_TICKS),
            compensated=self._config.compensator is not None,
            batch=newest,
        )

    def progress_failed(self, text: str) -> None:
        """Record that progress is no longer reported."""
        sample = self._page.get(PageField.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "warning", "progress_failed", text))

    def _conclude(self, *, ended: bool) -> None:
        result, said = self._safety.result, self._page.outcome() if ended else None
        if result is None:
            # Without a safe end, guardian or supervisor must act.
            self.outcome = said if self._page.ended_safely() else None
        else:
            reason = self._hang() if result.hung else said.reason if said else self._child.death()
            if self._safety.by == "guardian" and result.confirmed:
                reason += "; the guardian set the output to its safe value"
            output = describe(result.output, result.error)
            if not result.confirmed and not reason.endswith(output):
                reason += f"; {output}"
            last = said or LoopOutcome("fault", "", 0, "unknown")
            self.outcome = replace(last, code="fault", reason=reason, output=result.output)
        if self.outcome is not None:
            self._recording.end(self.outcome, lost_loop=result is not None and said is None)

    def _hang(self) -> str:
        """Return how the loop hung: a device may be slow, and the loop waits for it."""
        config, limit_s = self._config, self._config.timing.max_late_s
        waited = self._page.get(PageField.EXCHANGING) and not self._simulated
        if not waited or self._silent_ns <= 1e9 * (limit_s + 2.0 * config.tick_s):
            return "the loop process hung, and was killed"
        return (
            f"an exchange took longer than timing.max_late_s ({limit_s:g} s; {self._timeouts}), "
            "and the loop process was killed in it: lower timeout_s, or raise max_late_s"
        )

    def _pass_stop_on(self, stop_signal: int) -> None:
        page = self._page
        must_record = self._config.recording.on_failure == "stop"
        if not self._suspended and (suspended_s := self._suspend.suspended_s()):
            self._suspended = True
            text = f"the computer was suspended for {suspended_s:.3g} s: {SUSPEND_REMEDY}"
            sample = page.get(PageField.NEXT_SAMPLE)
            self._recording.record_event(Event(sample, "error", "suspended", text))
        if self._suspended:
            page.put(PageField.STOP, Stop.SUSPENDED)
        elif stop_signal:
            page.put(PageField.STOP, STOPS[signal.Signals(stop_signal)])
        elif self.broke:
            page.put(PageField.STOP, Stop.SUPERVISOR_BROKE)
        elif must_record and self._recording.stalled_s() > self._config.recording.ring_s / 2.0:
            # Not at the first error: a retry loses nothing while the ring is less than half full.
            failed = bool(self._recording.error)
            page.put(PageField.STOP, Stop.RECORDER_FAILED if failed else Stop.RECORDER_STALLED)


@cache
def _warn_refused(line: str) -> None:
    """Warn once per process: the runs of a study are refused the same."""
    _log.warning("real time refused, ticks may be late: %s", line)


def _refuse_suspend(number: int, frame: FrameType | None) -> None:
    """Explain in a thread why Ctrl-Z has no effect; the terminal may be blocked."""
    text = "Ctrl-Z cannot suspend a run: stop it with Ctrl-C; run --detach frees the terminal"
    threading.Thread(target=_log.warning, args=(text,), daemon=True).start()


class Supervisor:
    """Run one checked run into a recording per axis.

    Args:
        output: Recording of the only axis, or the name from which those of the axes are made.
    """

    def __init__(
        self,
        checked: CheckedRun,
        output: Path,
        *,
        overwrite: bool,
        take_over: bool = False,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._checked = checked
        self._take_over = take_over
        self._config = checked.config
        self._recordings = recordings_of(checked.names, output)
        self._overwrite = overwrite
        self._on_progress = on_progress
        self._notifier = SystemdNotifier()
        self._stop_signal = self._stops = 0

    def run(self) -> RunResult:
        """Run to the end.

        Raise InputError if the recording cannot be written or another run holds the device, and
        RunError if the loop failed to start. Then nothing has moved, and no file is left.
        """
        be_ordinary()
        config = self._config
        with ExitStack() as stack:
            # From before the loop starts to the very end: a signal must stop the loop, and a
            # second one must not discard the result of a run that has ended.
            stack.enter_context(self._signals())
            holds = self._checked.holds
            infos = [each.loaded.device.info for each in self._checked.axes]
            outputs = [OutputPlace(each.holds, each.output) for each in infos]
            relief = GuardianRelief(outputs)
            locks = stack.enter_context(DeviceLocks(holds, take_over=self._take_over))
            if not relief.runs:
                # The device before the recording: a refused run must not touch a file.
                locks.acquire()
            recorders = recorders_of(self._checked, self._recordings, overwrite=self._overwrite)
            try:
                folder, own = stack.enter_context(
                    run_folder(config.name, self._recordings, time.time(), holds, outputs)
                )
                rings = self._make_rings(folder)
                pages = [each.page for each in rings]
                page = pages[0]
                recording = RingRecorder(rings, recorders, config.recording.flush_s)
                requests = Requests(self._checked, folder, pages, recording)
                server = stack.enter_context(ControlServer(folder.socket, requests.answer))
                self._write_job(folder, locks.descriptors)
                # Kept open: watchers find them even if the folder is removed.
                for axis in range(len(rings)):
                    stack.enter_context(folder.description_of(axis).open("rb"))
                inherits = locks.descriptors + own
                child = LoopProcess(folder, page, inherits)
                inhibitor = stack.enter_context(SuspendInhibitor(needed=bool(holds)))
                run = folder, rings, child, recording
                acquire = partial(relief.acquire, locks, self._raise_if_stopped)
                safety, start_ns = self._start(stack, *run, inherits, acquire)
                suspend = SuspendDetector()
                started = RunMonitor(self._checked, page, child, safety, recording, suspend)
                if refusal := inhibitor.refusal():
                    _log.warning("suspend is not inhibited: %s: %s", refusal, SUSPEND_REMEDY)
            except BaseException:
                discard_all(recorders)
                raise
            _go(page, start_ns)
            # From here on the processes of this run keep the output safe.
            relief.relieve()
            self._announce_trigger()
            self._monitor(started, server)
            page.put(PageField.RECORDED, int(not recording.error))
            stops = self._stops
            guarded = safety.close(lambda: self._stops > stops)
            outcome = started.outcome
            assert outcome is not None
            unsafe = bool(holds) and outcome.output in {"set", "unknown"}
            if guarded or unsafe or recording.error:
                # For its guardian, the next command, or samples that are only in the rings.
                folder.keep(recorded=not recording.error)
            return self._result(outcome, started.broke, recording, page, folder, guarded=guarded)

    def _announce_trigger(self) -> None:
        trigger = self._config.trigger
        if trigger is not None and trigger.start is not None:
            name = self._checked.first.loaded.device.info.digital_input
            awaited = name, trigger.start, trigger.timeout_s
            _log.warning("waiting until %s is %s, at most %g s", *awaited)

    def _start(
        self,
        stack: ExitStack,
        folder: RunFolder,
        rings: Sequence[SampleRing],
        child: LoopProcess,
        recording: RingRecorder,
        inherits: list[int],
        acquire: Callable[[], None],
    ) -> tuple[SafetyMonitor, int]:
        """Wait until loop and guardian are ready, and begin the recording."""
        page, checked, safety = rings[0].page, self._checked, None
        try:
            guardian = partial(GuardianProcess, folder, page, inherits)
            needed = None if checked.simulated else guardian
            safety = SafetyMonitor(checked, rings, child, needed, recording.record_event)
            child.await_ready(lambda: self._stop_signal != 0, acquire)
            # Started after the loop, because it watches the loop's process.
            self._await_guardian(safety)
            start_ns = self._begin(recording.recorders, page)
            self._raise_if_stopped()
            # Before threads are started, so that they inherit it.
            stack.enter_context(favoured(child.pid))
            recording.start(start_ns)
        except BaseException as error:
            child.kill()  # it waits for the start signal: nothing has moved
            if safety is not None:
                safety.close()
            if isinstance(error, OSError):
                raise RunError(f"the run cannot be started: {error}; nothing has moved") from error
            raise
        return safety, start_ns

    def _raise_if_stopped(self) -> None:
        if self._stop_signal:
            raise RunError("stopped before the start; nothing has moved")

    def _await_guardian(self, safety: SafetyMonitor) -> None:
        deadline_s = time.monotonic() + _GUARDIAN_READY_S
        while not safety.ready():
            self._raise_if_stopped()
            if time.monotonic() > deadline_s:
                raise RunError(f"the guardian was not ready within {_GUARDIAN_READY_S:g} s")
            time.sleep(_POLL_S)

    def _begin(self, recorders: Sequence[Recorder], page: SharedPage) -> int:
        """Write the start of the recordings; return the monotonic time of sample 0 in ns.

        The files contain that time. If the disk is so slow that the time has passed, the start is
        written again with a later time; otherwise the first tick would be late.
        """
        set_up, learned, refused = json.loads(page.read_text(PageSlot.SET_UP))
        infos = [each.loaded.device.info for each in self._checked.axes]
        for line in [] if self._checked.simulated else refused:
            _warn_refused(line)
        # The watchdogs are armed between the start signal and sample 0.
        least_ns = _START_DELAY_NS + round(sum(each.arm_s for each in infos) * 1e9)
        delay_ns = least_ns
        for _ in range(_START_TRIES):
            began_ns = time.monotonic_ns()
            start_ns = began_ns + delay_ns
            start_unix_ns, waveform_at = time.time_ns() + delay_ns, page.get(PageField.WAVEFORM_AT)
            for recorder, facts in zip(recorders, learned, strict=True):
                recorder.begin(start_unix_ns, set_up | facts, waveform_at)
            took_ns = time.monotonic_ns() - began_ns
            if took_ns < delay_ns // 2:
                return start_ns
            delay_ns = least_ns + 3 * took_ns
        raise RunError(
            f"{recorders[0].path}: the disk took {took_ns * 1e-9:.3g} s for the first bytes; "
            "nothing has moved"
        )

    def _monitor(self, started: RunMonitor, server: ControlServer) -> None:
        """Monitor a run until its recording is closed, also after an error in this process."""
        shown: ProgressThread | None = None
        files = ", ".join(map(str, self._recordings.values()))
        try:
            shown = ProgressThread(started.progress, self._on_progress, started.progress_failed)
            shown.start()
            server.start()
            self._notifier.say("READY=1", f"STATUS=recording to {files}")
            while started.poll(self._stop_signal):
                self._notifier.alive()
                time.sleep(_POLL_S)
            self._notifier.say("STOPPING=1")
        except Exception as error:  # noqa: BLE001  output and recording must survive it
            started.break_off(error)
            self._monitor_only(started)
        if shown is not None:
            shown.end()

    def _monitor_only(self, started: RunMonitor) -> None:
        """Monitor a run without requests, progress and systemd."""
        while True:
            try:
                if not started.poll(self._stop_signal):
                    return
            except Exception as error:  # noqa: BLE001  the loop must not run without a supervisor
                started.break_off(error)
            time.sleep(_POLL_S)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(number: int, frame: FrameType | None) -> None:
            self._stop_signal = self._stop_signal or number
            self._stops += 1

        handlers = dict.fromkeys(JOB_CONTROL, signal.SIG_IGN) | dict.fromkeys(STOPS, note)
        handlers[signal.SIGTSTP] = _refuse_suspend
        before = {number: signal.signal(number, each) for number, each in handlers.items()}
        # Never the default: a late stop request would kill the process.
        if before[STOP_SIGNAL] == signal.SIG_DFL:
            before[STOP_SIGNAL] = signal.SIG_IGN
        try:
            yield
        finally:
            for number, handler in before.items():
                if handler is not None:  # None: not set by Python
                    signal.signal(number, handler)

    def _write_job(self, folder: RunFolder, locks: list[int]) -> None:
        """Write the job for loop and guardian, and the descriptions for watchers."""
        recording = self._config.recording
        # The supervisor may be silent until half of the ring is full.
        silence_s = recording.ring_s / 2.0 if recording.on_failure == "stop" else float("inf")
        job = Job.of(
            self._checked,
            folder,
            locks=locks,
            take_over=self._take_over,
            supervisor=os.getpid(),
            silence_s=silence_s,
        )
        job.write(folder.job)
        for number, axis in enumerate(self._checked.axes):
            RunDescription.of(axis).write(folder.description_of(number))

    def _make_rings(self, folder: RunFolder) -> list[SampleRing]:
        """Return a ring per axis; the page of the first one is that of the run."""
        config = self._config
        rings = []
        for number, checked in enumerate(self._checked.axes):
            info, path = checked.loaded.device.info, folder.ring_of(number)
            try:
                ring = SampleRing.create(
                    path,
                    slots=max(16, int(config.recording.ring_s / config.tick_s)),
                    block=config.block,
                    state_size=checked.state_size,
                    latency_blocks=info.latency_blocks,
                    aux=len(info.aux),
                )
            except OSError as error:
                raise RunError(
                    f"{path}: cannot allocate the sample ring ({error.strerror}): reduce "
                    "recording.ring_s"
                ) from None
            rings.append(ring)
        return rings

    def _result(
        self,
        outcome: LoopOutcome,
        broken: str,
        recording: RingRecorder,
        page: SharedPage,
        folder: RunFolder,
        *,
        guarded: bool,
    ) -> RunResult:
        requested = self._stop_signal == STOP_SIGNAL
        stop_signal = signal.SIGTERM if requested else self._stop_signal
        axes = dict(zip(self._checked.names, map(result_of, recording.recorders), strict=True))
        cut = ""
        if recording.error:
            missing = sum(each.missing for each in axes.values())
            cut = f"; {missing} samples are not in the recording: {recording.error}; "
            cut += f"those in memory are kept in {folder.path}: any hilctl command adds them when "
            cut += "the file can be written"
        broke = f"; the supervisor broke: {broken}" if broken else ""
        unasked = outcome.code == "stopped" and not stop_signal
        fault = recording.error or broken or unasked
        code = "fault" if fault else outcome.code
        first = next(iter(axes.values()))
        due = (first.samples + first.missing) // self._config.block
        skipped = page.lateness().skipped_ticks
        return RunResult.of(
            axes,
            code=code,
            reason=outcome.reason + broke + cut,
            output_state=outcome.output,
            guardian_active=guarded,
            stop_signal=stop_signal if code == "stopped" else 0,
            late_ticks=page.get(PageField.LATE_TICKS),
            deadline_misses=deadline_misses(skipped, due, self._config.timing.max_missed_share),
        )


def _go(page: SharedPage, start_ns: int) -> None:
    """Give the loop the start signal."""
    page.put(PageField.SUPERVISOR_HEARTBEAT_NS, time.monotonic_ns())
    page.put(PageField.START_NS, start_ns)
    # Last: then the loop reads its start time, and checks the heartbeat.
    page.publish(PageField.GO, 1)
