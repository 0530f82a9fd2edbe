"""The guardian: a small process that sets the output to its safe value if the loop cannot.

Started by the supervisor as ``python -m hilctl.run.safety.guardian JOB PIDFD PID``, with a pidfd
and the number of the loop process. Once it watches, it reads no file, imports nothing and waits for
no other process, so neither a disk nor the supervisor can delay the safe value.

It acts if the loop hangs or dies without a confirmed safe output. It retries until the device
confirms the safe value, even after the supervisor has ended; then SIGTERM ends it. The supervisor
drives the device only after the guardian has ended, so two processes never hold it.

Another command can claim the device. The guardian then closes it, releases its locks and waits for
them: it acts again when they are free, unless that command has relieved it.

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
from collections.abc import Callable
from contextlib import suppress
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


class SafeAction:
    """Drive a device to its safe value in a thread until the result is final.

    Args:
        device: Not open; each write opens a connection.
        goal: The safe value and the ramp to it.
        prepare: Called first in that thread.

    Attributes:
        failed: Error of this process, so that another one must try; may be empty.
    """

    def __init__(
        self,
        page: SharedPage,
        device: Device,
        goal: SafeGoal,
        *,
        hung: bool,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._device, self._page = device, page
        self._output = SafeOutput(device, goal, on_write=partial(_note_write, page, goal.value))
        self._hung, self._prepare = hung, prepare
        self._result = SafeActionResult(hung, "unknown", self._output.error, final=False)
        self._ending = threading.Event()
        self.failed = ""
        self._ended = RESERVE.run(self._run)

    def _run(self) -> None:
        output = self._output
        try:
            self._prepare()
            while not output.final and not self._ending.is_set():
                self._attempt()
                self._result = SafeActionResult(
                    self._hung, output.state, output.error, output.final
                )
                if output.pause_s >= PATIENT_PAUSE_S:
                    be_ordinary()
                if not output.final:
                    self._ending.wait(output.pause_s)
        except LocalError as error:
            self.failed = str(error)
        except Exception as error:  # noqa: BLE001  every error leaves the output unconfirmed
            self.failed = f"{type(error).__name__}: {error}"

    def _attempt(self) -> None:
        try:
            self._output.attempt()
        except LocalError:
            if not RESERVE.release():
                raise
        finally:
            self._page.put(PageField.UNANSWERED, int(self._output.pending))

    def result(self, wait_s: float = 0.0) -> SafeActionResult:
        """Return the result so far, after ``wait_s`` or as soon as it is final."""
        self._ended.wait(wait_s)
        return self._result

    @property
    def is_over(self) -> bool:
        """Whether nothing more is written: the result is final, it failed or was ended."""
        return self._ended.is_set()

    def end(self, wait_s: float) -> bool:
        """Stop writing; return whether the last write ends within ``wait_s``."""
        self._ending.set()
        return self._ended.wait(wait_s)

    def release_device(self, beat: Callable[[], object] = lambda: None) -> None:
        """Stop writing, which may take the device's timeout, and close the device."""
        while not self.end(_WAIT_S):
            beat()
        with suppress(Exception):  # the next process opens it anew
            self._device.close()


def _note_write(page: SharedPage, safe_value: float, value: float) -> None:
    """Leave to the next process where the ramp is, and that a command is without an answer."""
    page.note_safe_write(value)
    if value != safe_value:
        page.put(PageField.UNANSWERED, 1)


class Guardian:
    """Watch the loop, and set the output to its safe value if the loop died or hangs.

    Args:
        has_locks: Whether this process inherited the locks of the device.
    """

    def __init__(
        self,
        ring: SampleRing,
        device: Device,
        job: Job,
        prepare: Callable[[], object] = lambda: None,
        *,
        has_locks: bool = True,
    ) -> None:
        self._ring, self._page = ring, ring.page
        self._device, self._job = device, job
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
            axis = self._job.axes[0]
            goal = safe_goal(self._ring, self._device, axis.safe_value, axis.ramp_per_s)
            action = SafeAction(page, self._device, goal, hung=hung, prepare=self._prepare)
            if self._is_final(action):
                action.end(0.0)
                break
            action.release_device(self._beat)
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


def safe_goal(ring: SampleRing, device: Device, value: float, ramp_per_s: float) -> SafeGoal:
    """Return the goal after a loop that died, from its data in the ring."""
    page, info = ring.page, device.info
    # Loop, guardian or supervisor may have started the ramp.
    start = page.last_safe_write()
    if start is None:
        start = ring.last_command()
    # A loop that ended without a confirmed output lost its device in an exchange.
    lost = page.get(PageField.EXCHANGING) or page.get(PageField.PHASE) == Phase.ENDED
    if info.simulated:  # each process has its own simulation
        return SafeGoal(value, ramp_per_s, None, pending=False)
    return SafeGoal(value, ramp_per_s, start, bool(lost or page.get(PageField.UNANSWERED)))


def main(words: list[str]) -> int:
    """Guard one run; the exit code is 0 if the job could be read."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends after the loop
    job = Job.read(Path(words[0]))
    axis = job.axes[0]  # a run of several axes is simulated, and has no guardian
    ring = SampleRing(Path(axis.ring))
    page = ring.page
    page.put(PageField.GUARDIAN_PID, os.getpid())
    try:
        device = axis.device()
    except (HilctlError, MemoryError) as error:
        page.write_text(PageSlot.GUARDIAN, str(error) or "not enough memory")
        # After the text, which readers expect in this phase.
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.FAILED)
        return 1
    RESERVE.hold()
    "localhost".encode("idna")  # import the codec now, not at the first connection
    process = LinuxProcess()
    _stay_in_memory(process)
    be_quick(job.safe_priority, process)
    prepare = partial(be_quick, job.safe_priority, process)
    guardian = Guardian(ring, device, job, prepare, has_locks=words[1] != "wait")
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
