"""The child processes of a supervisor: loop and guardian; guardians of earlier runs."""

import logging
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Literal

from hilctl import OWN_ENVIRONMENT
from hilctl.base.errors import InputError, RunError
from hilctl.base.subprocesses import python_command
from hilctl.run.run_folder import (
    GUARDIAN,
    LOOP,
    DeviceLocks,
    OutputPlace,
    RunFolder,
    locked_run,
    runs,
)
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import GuardianPhase, PageField, PageSlot, Phase, SharedPage

_log = logging.getLogger(__name__)

_READY_TIMEOUT_S = 120.0
_DEATH_S = 0.1
_END_S = 1.0
_ACT_S = 10.0
_CLOSE_S = 40.0  # in which a guardian ends its last write, and closes its device
_TOLD_S = 1.0  # a wait that is longer is reported
_POLL_S = 0.01


def start_process(
    module: str, *words: str, inherits: Sequence[int], stderr: Any = None
) -> "subprocess.Popen[bytes]":
    """Start a module as a process of the run, which keeps the inherited descriptors open."""
    return subprocess.Popen(
        python_command("-m", module, *words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,  # otherwise a reader of the supervisor's waits for this process
        stderr=stderr,
        start_new_session=True,  # the supervisor handles Ctrl-C in the terminal
        env=OWN_ENVIRONMENT | os.environ,
        pass_fds=inherits,
    )


class ChildProcess:
    """A started process of a run."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self._process = process

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    def kill(self, wait_s: float = _DEATH_S) -> None:
        """Kill it; do not wait for a process that is blocked in the kernel."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)


class LoopProcess(ChildProcess):
    """The loop process of one run; see :mod:`hilctl.run.loop_process`."""

    def __init__(self, folder: RunFolder, page: SharedPage, inherits: Sequence[int]) -> None:
        self._page = page
        try:
            process = start_process(LOOP, str(folder.job), inherits=inherits)
        except OSError as error:
            raise RunError(f"cannot start the loop process: {error.strerror}") from None
        super().__init__(process)

    def await_ready(
        self, stopped: Callable[[], bool], acquire: Callable[[], object] = lambda: None
    ) -> None:
        """Wait until it is ready; raise InputError or RunError otherwise: nothing has moved.

        ``acquire`` is called when it needs the device, which a guardian may keep until then.
        """
        page = self._page
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while page.observe(PageField.PHASE) == Phase.STARTING and not self.ended:
            if stopped():
                raise RunError("stopped before the start; nothing has moved")
            if page.observe(PageField.AWAITS_DEVICE) and not page.get(PageField.HAS_DEVICE):
                acquire()
                page.publish(PageField.HAS_DEVICE, 1)
            if time.monotonic() > deadline:
                raise RunError(f"the loop was not ready within {_READY_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)
        if page.observe(PageField.PHASE) == Phase.REFUSED:
            raise InputError(page.read_text(PageSlot.ERROR))
        if page.observe(PageField.PHASE) == Phase.FAILED:
            raise RunError(page.read_text(PageSlot.ERROR))
        if page.observe(PageField.PHASE) != Phase.READY:
            raise RunError(f"the loop process died before the start: {self._death()}")

    def death(self) -> str:
        """Return why it left no outcome."""
        if self._page.observe(PageField.PHASE) == Phase.FAILED:
            return self._page.read_text(PageSlot.ERROR)
        return f"the loop process died: {self._death()}"

    def _death(self) -> str:
        code = self._process.poll()
        if code is None:
            return "it cannot be killed: it is blocked in the kernel"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


class GuardianProcess(ChildProcess):
    """The guardian of one run; see :mod:`hilctl.run.safety.guardian`.

    Args:
        loop: Process number of the loop to watch, or how to act without one.
    """

    def __init__(
        self,
        folder: RunFolder,
        page: SharedPage,
        inherits: Sequence[int],
        loop: int | Literal["act", "wait"],
    ) -> None:
        self._page = page
        page.put(PageField.GUARDIAN_PHASE, GuardianPhase.STARTING)
        page.put(PageField.GUARDIAN_HEARTBEAT_NS, 0)
        self._log = folder.guardian_log
        with ExitStack() as stack:
            watched = []
            if isinstance(loop, int):
                watched.append(os.pidfd_open(loop))
                stack.callback(os.close, watched[0])
            process = start_process(
                GUARDIAN,
                str(folder.job),
                *map(str, watched),
                str(loop),
                inherits=(*inherits, *watched),
                stderr=stack.enter_context(self._log.open("wb")),
            )
        super().__init__(process)

    @property
    def phase(self) -> GuardianPhase:
        """Its phase."""
        return GuardianPhase(self._page.get(PageField.GUARDIAN_PHASE))

    @property
    def heartbeat_ns(self) -> int:
        """Time of its last heartbeat, monotonic; 0 before the first."""
        return self._page.get(PageField.GUARDIAN_HEARTBEAT_NS)

    @property
    def error(self) -> str:
        """Why it ended."""
        if self.phase == GuardianPhase.FAILED:
            return self._page.read_text(PageSlot.GUARDIAN)
        with suppress(OSError):
            *_, last = self._log.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
            return f"it died: {last}" if last else "it died"
        return "it died"

    def await_acting(self, stopped: Callable[[], bool] = lambda: False) -> bool:
        """Wait until it drives the device; return False if it does not within 10 s."""
        deadline_s = time.monotonic() + _ACT_S
        while not self.ended and time.monotonic() < deadline_s and not stopped():
            if self.phase in {GuardianPhase.ACTING, GuardianPhase.DONE}:
                return True
            time.sleep(_POLL_S)
        return False

    def end(self) -> None:
        """Wait briefly for its end, which follows the loop's; otherwise kill it."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
            return
        self.kill()


class GuardianRelief:
    """Take devices over from guardians of earlier runs, which keep them until they are relieved.

    If this process and those that inherit its locks end before, the guardians act again. A guardian
    with another output than these keeps its devices: nothing else would make that one safe.

    Args:
        outputs: The outputs to be taken over.
    """

    def __init__(self, outputs: Sequence[OutputPlace]) -> None:
        self._runs: list[tuple[RunFolder, list[SharedPage]]] = []
        for run in runs() if any(each.holds for each in outputs) else []:
            real = [each for each in run.card.outputs if each.holds]
            covered = all(any(each.is_same(one) for one in outputs) for each in real)
            if real and covered and not run.supervised:
                with suppress(OSError, ValueError):  # it has just ended
                    numbers = range(len(run.card.outputs))
                    pages = [SampleRing(run.ring_of(number)).page for number in numbers]
                    if not pages[0].is_settled():
                        self._runs.append((run, pages))

    @property
    def runs(self) -> list[RunFolder]:
        """The runs whose guardian is active."""
        return [run for run, _ in self._runs if run.alive]

    def acquire(self, locks: DeviceLocks, check: Callable[[], object] = lambda: None) -> None:
        """Acquire the locks of the devices; raise InputError if a guardian does not release them.

        ``check`` is called repeatedly, and may raise an error to give up.
        """
        began_s, told = time.monotonic(), False
        while self.runs and (name := locks.holder()) and time.monotonic() < began_s + _CLOSE_S:
            check()
            if not told and time.monotonic() > began_s + _TOLD_S:
                named = ", ".join(run.card.name for run in self.runs)
                text = "waiting until the guardian of %s releases %s, at most %g s"
                _log.warning(text, named, name, _CLOSE_S)
                told = True
            for _, (page, *_) in self._runs:
                page.put(PageField.CLAIM, 1)
            time.sleep(_POLL_S)
        locks.acquire()

    def unanswered(self, output: OutputPlace) -> bool:
        """Return whether an earlier run left a command to an output without an answer."""
        return any(page.get(PageField.UNANSWERED) for page in self._pages(output))

    def note_write(self, output: OutputPlace, value: float) -> None:
        """Let the guardians continue the ramp of an output from here if they act again."""
        for page in self._pages(output):
            page.note_safe_write(value, bool(page.get(PageField.UNANSWERED)))

    def _pages(self, output: OutputPlace) -> Iterator[SharedPage]:
        """Yield the pages of the axes of earlier runs that had an output."""
        for run, pages in self._runs:
            for each, page in zip(run.card.outputs, pages, strict=True):
                if each.is_same(output):
                    yield page

    def relieve(self) -> None:
        """Let the guardians end and remove their folders: another process protects the devices."""
        for run, (page, *_) in self._runs:
            page.put(PageField.RELIEVED, 1)
            if page.get(PageField.RECORDED):
                with suppress(OSError):
                    run.remove()

    def restart(self) -> None:
        """Start the guardians again that have died; they act when the device is free."""
        for run, (page, *_) in self._runs:
            if not run.alive:
                try:
                    with locked_run(run) as lock:
                        GuardianProcess(run, page, [lock], "wait")
                except OSError as error:
                    text = "the guardian of %s cannot be started again: %s"
                    _log.error(text, run.card.name, error.strerror)


def signal_guardian(run: RunFolder, number: int) -> bool:
    """Send a signal to the guardian of a run; return whether there was one."""
    try:
        guardian = os.pidfd_open(
            SampleRing(run.ring, look_only=True).page.get(PageField.GUARDIAN_PID)
        )
    except (OSError, ValueError):
        return False  # it has just ended
    try:
        # Checked after opening it: while the lock is held, the number is not reused.
        if not run.alive:
            return False
        signal.pidfd_send_signal(guardian, number)
    except ProcessLookupError:
        return False
    finally:
        os.close(guardian)
    return True
