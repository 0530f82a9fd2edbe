"""The guardian: a small process that sets the output to its safe value if the loop cannot.

Started by the supervisor as ``python -m hilctl.run.safety.guardian JOB PIDFD PID``, with a pidfd
and the number of the loop process. Once it watches, it reads no file, imports nothing and waits for
no other process, so neither a disk nor the supervisor can delay the safe value.

It acts if the loop hangs or dies without a confirmed safe output. It retries until the device
confirms the safe value, even after the supervisor has ended; then SIGTERM ends it. The supervisor
drives the device only after the guardian has ended, so two processes never hold it.

As ``python -m hilctl.run.safety.guardian JOB act`` it acts immediately, without a loop to watch.
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
from hilctl.loop.safe_output import LocalError, SafeGoal, SafeOutput
from hilctl.machine.rt_setup import be_quick
from hilctl.machine.syscalls import LinuxProcess
from hilctl.run.job import Job, SilenceLimits
from hilctl.run.run_folder import keep_removed
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
        self._output = SafeOutput(device, goal, on_write=page.note_safe_write)
        self._hung, self._prepare = hung, prepare
        self._result = SafeActionResult(hung, "unknown", self._output.error, final=False)
        self._ending = threading.Event()
        self.failed = ""
        # A daemon, so that a device that blocks forever does not keep the process alive.
        self._thread = threading.Thread(target=self._run, name="safe action", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        output = self._output
        try:
            self._prepare()
            while not output.final and not self._ending.is_set():
                output.attempt()
                self._result = SafeActionResult(
                    self._hung, output.state, output.error, output.final
                )
                if not output.final:
                    self._ending.wait(output.pause_s)
        except LocalError as error:
            self.failed = str(error)
        except Exception as error:  # noqa: BLE001  every error leaves the output unconfirmed
            self.failed = f"{type(error).__name__}: {error}"

    def result(self, wait_s: float = 0.0) -> SafeActionResult:
        """Return the result so far, after ``wait_s`` or as soon as it is final."""
        self._thread.join(wait_s)
        return self._result

    def end(self, wait_s: float) -> bool:
        """Stop writing; return whether the last write ends within ``wait_s``."""
        self._ending.set()
        self._thread.join(wait_s)
        return not self._thread.is_alive()


class Guardian:
    """Watch the loop, and set the output to its safe value if the loop died or hangs."""

    def __init__(
        self,
        ring: SampleRing,
        device: Device,
        job: Job,
        pidfd: int,
        loop: int,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._ring, self._page = ring, ring.page
        self._device, self._job, self._pidfd = device, job, pidfd
        self._prepare = prepare
        self._watch = HangWatch(ring.page, job.limits, lambda: is_stopped(loop))
        self._death = select.poll()
        self._death.register(pidfd, select.POLLIN)

    def watch(self) -> bool:
        """Watch until the output is safe; return False if another process must drive the device."""
        page = self._page
        page.put(PageField.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        # After the heartbeat: an old one would count as silence.
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.WATCHING)
        while True:
            now_ns = time.monotonic_ns()
            page.put(PageField.GUARDIAN_HEARTBEAT_NS, now_ns)
            if self._death.poll(_POLL_MS):
                # Without the start signal nothing was sent.
                if not page.get(PageField.GO) or page.ended_safely():
                    return True
                return act(page, self._device, self._goal(), hung=False, prepare=self._prepare)
            if self._watch.hangs(now_ns):
                self._kill_loop()
                if page.ended_safely():
                    return True
                return act(page, self._device, self._goal(), hung=True, prepare=self._prepare)

    def _goal(self) -> SafeGoal:
        return safe_goal(self._ring, self._device, self._job.safe_value, self._job.ramp_per_s)

    def _kill_loop(self) -> None:
        """Kill the loop: if it continued, it would send old commands."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        self._death.poll(LAST_CALL_MS)


def safe_goal(ring: SampleRing, device: Device, value: float, ramp_per_s: float) -> SafeGoal:
    """Return the goal after a loop that died, from its data in the ring."""
    page, info = ring.page, device.info
    # Loop, guardian or supervisor may have started the ramp.
    start = page.last_safe_write()
    if start is None:
        start = ring.last_command()
    # A loop that ended without a confirmed output lost its device in an exchange.
    unanswered = page.get(PageField.EXCHANGING) or page.get(PageField.PHASE) == Phase.ENDED
    if info.simulated:  # each process has its own simulation
        return SafeGoal(value, ramp_per_s, None, pending=False)
    return SafeGoal(value, ramp_per_s, start, bool(unanswered))


def act(
    page: SharedPage,
    device: Device,
    goal: SafeGoal,
    *,
    hung: bool,
    prepare: Callable[[], object] = lambda: None,
) -> bool:
    """Drive the device until the result is final or SIGTERM; return False if that is impossible."""
    ended_by_user = False

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal ended_by_user
        ended_by_user = True

    page.leave_safe_result(SafeActionResult(hung, "unknown", "", final=False))
    page.put(PageField.GUARDIAN_PHASE, GuardianPhase.ACTING)
    signal.signal(signal.SIGTERM, end)
    action = SafeAction(page, device, goal, hung=hung, prepare=prepare)
    while not (result := action.result(_POLL_MS * 1e-3)).final and not ended_by_user:
        page.put(PageField.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        page.leave_safe_result(result)
        if action.failed:
            _fail(page, action.failed)
            return False
    page.leave_safe_result(result)
    return True


def _fail(page: SharedPage, text: str) -> None:
    page.write_text(PageSlot.GUARDIAN, text)
    # After the text, which readers expect in this phase.
    page.put(PageField.GUARDIAN_PHASE, GuardianPhase.FAILED)


def main(words: list[str]) -> int:
    """Guard one run; the exit code is 0 if the job could be read and the device driven."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends after the loop
    job = Job.read(Path(words[0]))
    ring = SampleRing(Path(job.ring))
    page = ring.page
    page.put(PageField.GUARDIAN_PID, os.getpid())
    try:
        device = job.device()
    except (HilctlError, MemoryError) as error:
        _fail(page, str(error) or "not enough memory")
        return 1
    "localhost".encode("idna")  # import the codec now, not at the first connection
    process = LinuxProcess()
    _stay_in_memory(process)
    be_quick(job.safe_priority, process)
    prepare = partial(be_quick, job.safe_priority, process)
    if words[1] == "act":
        goal = safe_goal(ring, device, job.safe_value, job.ramp_per_s)
        done = act(page, device, goal, hung=False, prepare=prepare)
    else:
        done = Guardian(ring, device, job, int(words[1]), int(words[2]), prepare).watch()
    if os.getppid() != job.supervisor:
        _leave_folder(Path(words[0]).parent, page)
    return 0 if done else 1


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
