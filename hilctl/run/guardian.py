"""The guardian: a small process that sets the output to its safe value if the loop cannot.

Started by the supervisor as ``python -m hilctl.run.guardian JOB PIDFD PID``, with a pidfd and the
number of the loop process. Once it watches, it reads no file, imports nothing and waits for no
other process, so neither a disk nor the supervisor can delay the safe value.

It acts if the loop dies without a confirmed safe output, or hangs. It keeps trying until the device
confirms the safe value, also after the supervisor has ended; SIGTERM ends it then. The supervisor
drives the device only after the guardian has ended or was killed, so two processes never hold it.

As ``python -m hilctl.run.guardian JOB act`` it has no loop to watch, and acts at once.
"""

import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType

from hilctl.base.device import Device
from hilctl.base.errors import HilctlError
from hilctl.loop.safe_output import SafeGoal
from hilctl.machine.linux import LinuxProcess
from hilctl.machine.realtime import be_quick
from hilctl.run.hang_watch import HangWatch, is_stopped
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import keep_removed
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import (
    Field,
    GuardianPhase,
    PageText,
    Phase,
    SafeActionResult,
    SharedPage,
)

_POLL_MS = 5
LAST_CALL_MS = 5
"""How long a process that was killed may be in a call that it is to end. Then it is dying: giving
back its memory takes much longer, and only a device that takes one connection waits for that."""


class Guardian:
    """Watches the loop, and sets the output to its safe value if the loop died or hangs.

    Args:
        ring: Shared with loop and supervisor.
        device: Not open.
        job: What to guard.
        pidfd: A pidfd of the loop's process.
        loop: Its process number.
        prepare: Called first in the thread that drives the device.
    """

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
        """Watch until the loop is gone, and the output safe if that can be had.

        Returns:
            False if this process cannot drive the device, and another one has to.
        """
        page = self._page
        page.put(Field.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        # After the heartbeat: an old one would pass for silence.
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.WATCHING)
        while True:
            now_ns = time.monotonic_ns()
            page.put(Field.GUARDIAN_HEARTBEAT_NS, now_ns)
            if self._death.poll(_POLL_MS):
                # Without the start signal nothing was sent: the output is as it was before.
                if not page.get(Field.GO) or page.ended_safely():
                    return True
                return act(page, self._device, self._goal(), hung=False, prepare=self._prepare)
            if self._watch.hangs(now_ns):
                self._kill_loop()
                return act(page, self._device, self._goal(), hung=True, prepare=self._prepare)

    def _goal(self) -> SafeGoal:
        return safe_goal(self._ring, self._device, self._job.safe_value, self._job.ramp_per_s)

    def _kill_loop(self) -> None:
        """End the loop for good: should it go on, it would send commands from before."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        self._death.poll(LAST_CALL_MS)


def safe_goal(ring: SampleRing, device: Device, value: float, ramp_per_s: float) -> SafeGoal:
    """Return where the output goes after a loop that has died, by what it left in the ring."""
    page, info = ring.page, device.info
    # Loop, guardian or supervisor may have been on the way before.
    start = page.last_safe_write()
    if start is None:
        start = ring.last_command()
    # A loop that has ended without a confirmed output lost its device in an exchange.
    unanswered = page.get(Field.EXCHANGING) or page.get(Field.PHASE) == Phase.ENDED
    if info.simulated:  # another process has a simulation of its own
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
    """Drive the device until its safe value is confirmed, cannot be, or SIGTERM ends it.

    Args:
        page: Shared with the supervisor; shows how far it is.
        device: Not open.
        goal: Where the output goes.
        hung: Whether the loop had to be killed.
        prepare: Called first in the thread that drives the device.

    Returns:
        False if this process cannot drive the device, and another one has to.
    """
    ended_by_user = False

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal ended_by_user
        ended_by_user = True

    page.leave_safe_result(SafeActionResult(hung, "unknown", "", final=False))
    page.put(Field.GUARDIAN_PHASE, GuardianPhase.ACTING)
    signal.signal(signal.SIGTERM, end)
    action = SafeAction(page, device, goal, hung=hung, prepare=prepare)
    while not (result := action.result(_POLL_MS * 1e-3)).final and not ended_by_user:
        page.put(Field.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        page.leave_safe_result(result)
        if action.failed:
            _fail(page, action.failed)
            return False
    page.leave_safe_result(result)
    return True


def _fail(page: SharedPage, text: str) -> None:
    page.write_text(PageText.GUARDIAN, text)
    # The text first: the phase says that it is there.
    page.put(Field.GUARDIAN_PHASE, GuardianPhase.FAILED)


def main(words: list[str]) -> int:
    """Guard one run; the exit code is 0 if the job could be read and the device driven."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the loop, and not before
    job = Job.read(Path(words[0]))
    ring = SampleRing(Path(job.ring))
    page = ring.page
    page.put(Field.GUARDIAN_PID, os.getpid())
    try:
        device = job.device()
    except (HilctlError, MemoryError) as error:
        _fail(page, str(error) or "not enough memory")
        return 1
    "localhost".encode("idna")  # the codec, which is imported at the first connection otherwise
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
    """Remove the run's folder if nothing is left to do, or see that it can be recovered."""
    if page.get(Field.RECORDED) and page.get(Field.GUARDIAN_PHASE) == GuardianPhase.DONE:
        shutil.rmtree(folder, ignore_errors=True)
    else:
        keep_removed()


def _stay_in_memory(process: LinuxProcess) -> None:
    """Keep all that is needed in RAM where that is allowed: to read it back may need a disk."""
    process.freeze_gc()
    with suppress(OSError):
        if process.lockable_bytes() is None:
            process.lock_memory()


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except MemoryError:
        sys.exit("hilctl: not enough memory for the guardian")
