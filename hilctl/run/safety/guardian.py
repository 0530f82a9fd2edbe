"""The guardian: a small process that sets the outputs to their safe values if the loop cannot.

Started by the supervisor as ``python -m hilctl.run.safety.guardian JOB PIDFD PID``, with a pidfd
and the number of the loop process. Once it watches, it reads no file, imports nothing and waits for
no other process, so neither a disk nor the supervisor can delay the safe value.

It acts if the loop hangs or dies without confirmed safe outputs. It retries until each device
confirms its safe value, even after the supervisor has ended; then SIGTERM ends it. The supervisor
drives the devices only after the guardian has ended, so two processes never hold them.

Another command can claim the devices. The guardian then closes them, releases their locks and waits
for them: it acts again when they are free, unless that command has relieved it.

As ``python -m hilctl.run.safety.guardian JOB act`` it acts without a loop to watch, as soon as the
supervisor does not; as ``JOB wait`` it first waits for the locks of the device.
"""

import os
import select
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType

from hilctl.base.device import Device
from hilctl.base.errors import HilctlError
from hilctl.experiment.sections.timing import SilenceLimits
from hilctl.loop.safe_output import (
    PATIENT_AFTER_S,
    PATIENT_PAUSE_S,
    LocalError,
    SafeGoal,
    SafeOutput,
    drive_in_turn,
    joint_report,
    lines_of,
)
from hilctl.machine.reserve import RESERVE
from hilctl.machine.rt_setup import be_ordinary, be_quick
from hilctl.machine.syscalls import LinuxProcess
from hilctl.run.job import Job
from hilctl.run.run_folder import DeviceLocks, keep_removed
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import (
    GuardianPhase,
    PageField,
    PageSlot,
    Phase,
    SafeActionResult,
    SharedPage,
)

_LONGEST_POLL_NS = 10_000_000
_CLOSING_S = 30.0
_POLL_MS = 5
_AGAIN_S = 1.0
_WAIT_S = 0.05
_CLAIM_S = 0.2  # in which a command that claims the device must acquire the locks
LAST_CALL_MS = 5
"""Longest wait for a killed process to leave a system call.

Its memory is released much later, which only matters to a device that accepts one connection.
"""


class HangWatch:
    """Detect a live loop without heartbeat.

    A stall of the whole computer stalls this process too, so the time between two polls counts only
    up to :data:`_LONGEST_POLL_NS`.
    """

    def __init__(
        self, page: SharedPage, limits: SilenceLimits, is_stopped: Callable[[], bool]
    ) -> None:
        self._page = page
        self._limits = limits
        self._is_stopped = is_stopped
        self._heartbeat_ns = -1
        self._polled_ns = self._silent_ns = 0

    def hangs(self, now_ns: int) -> bool:
        """Poll once; return whether the loop has been silent for too long."""
        page = self._page
        heartbeat_ns, phase = page.get(PageField.LOOP_HEARTBEAT_NS), page.get(PageField.PHASE)
        watched = phase in {Phase.RUNNING, Phase.CLOSING, Phase.ENDED, Phase.FAILED}
        passed_ns, self._polled_ns = now_ns - self._polled_ns, now_ns
        if heartbeat_ns != self._heartbeat_ns or not watched:
            self._heartbeat_ns, self._silent_ns = heartbeat_ns, 0
            return False
        self._silent_ns += min(passed_ns, _LONGEST_POLL_NS)
        silent_s = self._silent_ns * 1e-9
        limits = self._limits
        loop_s = limits.real_time_s if page.get(PageField.REAL_TIME) else limits.ordinary_s
        beats = phase in {Phase.RUNNING, Phase.CLOSING}
        if beats and silent_s > loop_s + self._wait_s(phase):
            return True
        # A process that is stopped never exits. Last: it reads /proc.
        return silent_s > limits.stopped_s and self._is_stopped()

    def _wait_s(self, phase: int) -> float:
        """Return how long the loop may wait for its device."""
        # Closing a lost device takes its timeouts; before the first tick nothing moves.
        if phase == Phase.CLOSING or not self._page.get(PageField.LOOP_HEARTBEAT_NS):
            return _CLOSING_S
        return self._limits.exchange_s if self._page.get(PageField.EXCHANGING) else 0.0


def is_stopped(process: int) -> bool:
    """Return whether a process is stopped or traced; False if it does not exist."""
    try:
        stat = Path(f"/proc/{process}/stat").read_bytes()
    except OSError:
        return False
    # After the program's name, which may contain spaces and brackets.
    return stat.rpartition(b")")[2].split()[0] in {b"T", b"t"}


@dataclass(frozen=True, slots=True)
class GuardedAxis:
    """One axis of a run, whose output another process sets to its safe value after the loop.

    Attributes:
        name: Name of the axis; empty if it is the only one.
        device: Not open; each write opens a connection.
        safe_value: In the device's command unit.
        ramp_per_s: Slew rate of the ramp to it, > 0.
    """

    name: str
    device: Device
    ring: SampleRing
    safe_value: float
    ramp_per_s: float

    def output(self, began_s: float) -> SafeOutput:
        """Return the ramp that begins where the loop, or another process, left the output."""
        page, start, unanswered = self.ring.page, None, False
        if not self.device.info.simulated:  # each process has its own simulation
            # Loop, guardian or supervisor may have started the ramp.
            start = page.last_safe_write()
            if start is None:
                start = self.ring.last_command()
            unanswered = bool(page.get(PageField.UNANSWERED))
        goal = SafeGoal(self.safe_value, self.ramp_per_s, start, unanswered)
        return SafeOutput(self.device, goal, began_s, note=page.note_safe_write)


class _Line:
    """The outputs of one line, and the thread that drives them until all are final.

    Attributes:
        failed: Error of this process, so that another one must try; may be empty.
    """

    def __init__(
        self, axes: Sequence[GuardedAxis], began_s: float, prepare: Callable[[], object]
    ) -> None:
        self.axes = axes
        self.outputs = [each.output(began_s) for each in axes]
        self._prepare = prepare
        self.ending, self.ended = threading.Event(), threading.Event()
        self.failed = ""
        try:
            self.ended = RESERVE.run(self._run)
        except RuntimeError as error:
            self.failed = str(error)
            self.ended.set()

    def _run(self) -> None:
        try:
            self._prepare()
            drive_in_turn(self.outputs, self.ending.is_set, self._wait, RESERVE.release)
        except LocalError as error:
            self.failed = str(error)
        except Exception as error:  # noqa: BLE001  every error leaves the output unconfirmed
            self.failed = f"{type(error).__name__}: {error}"

    def _wait(self, wait_s: float) -> bool:
        if all(each.pause_s >= PATIENT_PAUSE_S for each in self.outputs):
            be_ordinary()
        return self.ending.wait(wait_s)


class SafeAction:
    """Drive outputs to their safe values until all are final; all ramps begin now.

    Each line has a thread of its own, see :func:`hilctl.loop.safe_output.lines_of`.

    Args:
        prepare: Called first in each thread.
    """

    def __init__(
        self,
        axes: Sequence[GuardedAxis],
        *,
        hung: bool,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._hung, self._prepare = hung, prepare
        began_s = time.monotonic()
        self._lines = [_Line(line, began_s, prepare) for line in lines_of(axes)]

    def result(self, wait_s: float = 0.0) -> SafeActionResult:
        """Return the result so far, after ``wait_s`` or as soon as it is final."""
        self._await(wait_s)
        outputs = [each for line in self._lines for each in line.outputs]
        names = [each.name for line in self._lines for each in line.axes]
        report = joint_report([each.report for each in outputs], names)
        return SafeActionResult(self._hung, *report)

    @property
    def failed(self) -> str:
        """Errors of this process, so that another one must try; may be empty."""
        return "; ".join(dict.fromkeys(each.failed for each in self._lines if each.failed))

    def retry_failed(self) -> None:
        """Drive the outputs again that this process failed to drive."""
        for k, line in enumerate(self._lines):
            if line.failed:
                self._lines[k] = _Line(line.axes, time.monotonic(), self._prepare)

    @property
    def is_over(self) -> bool:
        """Whether nothing more is written: all is final, failed or ended."""
        return self._await(0.0)

    def end(self, wait_s: float) -> bool:
        """Stop writing; return whether the last writes end within ``wait_s``."""
        for line in self._lines:
            line.ending.set()
        return self._await(wait_s)

    def release_devices(self, beat: Callable[[], object] = lambda: None) -> None:
        """Stop writing, which may take the devices' timeouts, and close the devices."""
        while not self.end(_WAIT_S):
            beat()
        for axis in (axis for line in self._lines for axis in line.axes):
            with suppress(Exception):  # the next process opens it anew
                axis.device.close()

    def _await(self, wait_s: float) -> bool:
        until_s = time.monotonic() + wait_s
        return all(line.ended.wait(max(0.0, until_s - time.monotonic())) for line in self._lines)


class Guardian:
    """Watch the loop, and set the output to its safe value if the loop died or hangs.

    Args:
        page: Page of the run.
        has_locks: Whether this process inherited the locks of the device.
    """

    def __init__(
        self,
        axes: Sequence[GuardedAxis],
        page: SharedPage,
        job: Job,
        prepare: Callable[[], object] = lambda: None,
        *,
        has_locks: bool = True,
    ) -> None:
        self._axes, self._page, self._job = axes, page, job
        self._prepare = prepare
        self._locks = DeviceLocks(
            job.holds, take_over=job.take_over, inherited=job.locks if has_locks else ()
        )
        self._ended = threading.Event()  # by the user

    def watch(self, pidfd: int, loop: int) -> None:
        """Watch the loop, by its pidfd and number, until the output is safe; act if necessary."""
        page = self._page
        watch = HangWatch(page, self._job.limits, lambda: is_stopped(loop))
        death = select.poll()
        death.register(pidfd, select.POLLIN)
        page.put(PageField.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        # After the heartbeat: an old one would count as silence.
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.WATCHING)
        hung = False
        while not death.poll(_POLL_MS):
            now_ns = time.monotonic_ns()
            page.put(PageField.GUARDIAN_HEARTBEAT_NS, now_ns)
            if hung := watch.hangs(now_ns):
                # If it continued, it would send old commands.
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(pidfd, signal.SIGKILL)
                death.poll(LAST_CALL_MS)
                break
        # Without the start signal nothing was sent.
        if page.get(PageField.GO) and not page.ended_safely():
            self.act(hung=hung)

    def act(self, *, hung: bool) -> None:
        """Drive the device until the result is final, SIGTERM, or another process relieves it."""
        page = self._page
        page.leave_safe_result(SafeActionResult(hung, "unknown", "", final=False))
        signal.signal(signal.SIGTERM, self._end)
        while self._awaits_device():
            page.put(PageField.GUARDIAN_PHASE, GuardianPhase.ACTING)
            action = SafeAction(self._axes, hung=hung, prepare=self._prepare)
            if self._is_final(action):
                action.end(0.0)
                break
            action.release_devices(self._beat)
            if page.get(PageField.CLAIM):
                self._release_locks()
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.DONE)

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._ended.set()

    def _beat(self) -> None:
        self._page.put(PageField.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())

    def _is_final(self, action: SafeAction) -> bool:
        """Follow an action to its end; return False if it must be interrupted or repeated."""
        page, poll_s, began_s = self._page, _POLL_MS * 1e-3, time.monotonic()
        while not (result := action.result(poll_s)).final and not self._ended.is_set():
            self._beat()
            page.leave_safe_result(result)
            if action.failed:
                # The supervisor kills this process before it acts itself; without one, try again.
                page.write_text(PageSlot.GUARDIAN, action.failed)
                page.put(PageField.GUARDIAN_PHASE, GuardianPhase.FAILED)
                self._ended.wait(_AGAIN_S)
                return False
            if page.get(PageField.CLAIM):
                return False
            if time.monotonic() - began_s > PATIENT_AFTER_S and not self._supervised():
                be_ordinary()
                poll_s = _AGAIN_S
        page.leave_safe_result(result)
        return True

    def _supervised(self) -> bool:
        return os.getppid() == self._job.supervisor

    def _release_locks(self) -> None:
        """Release the locks of the device, for the command that claims it."""
        page = self._page
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.WAITING)
        page.put(PageField.CLAIM, 0)
        self._locks.release()
        self._ended.wait(_CLAIM_S)

    def _awaits_device(self) -> bool:
        """Wait until no other process has the device; return False if that is not necessary."""
        while not (self._ended.is_set() or self._page.get(PageField.RELIEVED)):
            self._beat()
            if not (self._page.get(PageField.STANDS_IN) and self._supervised()):
                if not self._locks.holder():
                    return True
                self._locks.release()
            self._page.put(PageField.GUARDIAN_PHASE, GuardianPhase.WAITING)
            self._ended.wait(_WAIT_S)
        return False


def main(words: list[str]) -> int:
    """Guard one run; the exit code is 0 if the job could be read."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends after the loop
    job = Job.read(Path(words[0]))
    rings = [SampleRing(Path(each.ring)) for each in job.axes]
    page = rings[0].page
    page.put(PageField.GUARDIAN_PID, os.getpid())
    try:
        axes = [
            GuardedAxis(each.axis, each.device(), ring, each.safe_value, each.ramp_per_s)
            for each, ring in zip(job.axes, rings, strict=True)
        ]
    except (HilctlError, MemoryError) as error:
        page.write_text(PageSlot.GUARDIAN, str(error) or "not enough memory")
        # After the text, which readers expect in this phase.
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.FAILED)
        return 1
    RESERVE.hold(len(axes))
    "localhost".encode("idna")  # import the codec now, not at the first connection
    process = LinuxProcess()
    _stay_in_memory(process)
    be_quick(job.safe_priority, process)
    prepare = partial(be_quick, job.safe_priority, process)
    guardian = Guardian(axes, page, job, prepare, has_locks=words[1] != "wait")
    if words[1] in {"act", "wait"}:
        guardian.act(hung=False)
    else:
        guardian.watch(int(words[1]), int(words[2]))
    if os.getppid() != job.supervisor:
        _leave_folder(Path(words[0]).parent, page)
    return 0


def _leave_folder(folder: Path, page: SharedPage) -> None:
    """Remove the run's folder if it is complete; otherwise keep it for recovery."""
    if page.get(PageField.RECORDED) and page.get(PageField.GUARDIAN_PHASE) == GuardianPhase.DONE:
        shutil.rmtree(folder, ignore_errors=True)
    else:
        keep_removed()


def _stay_in_memory(process: LinuxProcess) -> None:
    """Lock all memory if that is allowed: a page fault may need a disk."""
    process.freeze_gc()
    with suppress(OSError):
        if process.lockable_bytes() is None:
            process.lock_memory(untouched=True)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except MemoryError:
        sys.exit("hilctl: not enough memory for the guardian")
