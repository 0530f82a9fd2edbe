"""The guardian as a child process: start it, read its phase and heartbeat, end it.

What it does is in :mod:`hilctl.run.guardian`, which imports as little as possible.
"""

import logging
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress

from hilctl.experiment.check import Checked
from hilctl.run.guardian import GuardianJob
from hilctl.run.hang_watch import SilenceLimits
from hilctl.run.ring import SampleRing, safe_result_of
from hilctl.run.run_folder import RunFolder, locked_run, runs
from hilctl.run.shared_page import Field, GuardianPhase, PageText, SharedPage

_log = logging.getLogger(__name__)

_END_S = 1.0
_DEATH_S = 0.1
_SIMULATED_MARGIN_S = 0.5
_HANG_S = 0.08
_STOPPED_S = 0.02


def silence_limits(checked: Checked) -> SilenceLimits:
    """Return how long the loop of an experiment may be silent."""
    config = checked.loaded.config
    timing = config.timing
    simulated = checked.loaded.device.info.simulated
    hang_s = ordinary_s = timing.hang_s
    if hang_s is None or ordinary_s is None:
        # Without real-time priority a loop may be as late as its own limit tolerates.
        ordinary_s = timing.max_late_s + (_SIMULATED_MARGIN_S if simulated else 0.0)
        hang_s = ordinary_s if simulated else min(_HANG_S, ordinary_s)
    periods_s = 2.0 * config.tick_s
    return SilenceLimits(
        real_time_s=periods_s + hang_s,
        ordinary_s=periods_s + ordinary_s,
        # A device that takes longer makes the next tick too late, which ends the run as well.
        exchange_s=timing.max_late_s,
        # Without a coil to protect, who stops a loop may be looking into it with a debugger.
        stopped_s=periods_s + (hang_s if simulated else min(hang_s, _STOPPED_S)),
    )


def safe_priority(checked: Checked) -> int:
    """Return the SCHED_FIFO priority of whoever makes the output safe.

    Above the loop: one that runs wild at its own priority must not keep that waiting.
    """
    return checked.loaded.config.realtime.priority + 1


class GuardianProcess:
    """The guardian of one run; see :mod:`hilctl.run.guardian`.

    Args:
        folder: The run's folder, with the guardian's job and the ring.
        page: Shared with it.
        inherits: Descriptors of locks that it is to hold.
        loop: Process number of the loop to watch; None to act at once.

    Raises:
        OSError: It cannot be started.
    """

    def __init__(
        self, folder: RunFolder, page: SharedPage, inherits: Sequence[int], loop: int | None
    ) -> None:
        self._page = page
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.STARTING)
        page.put(Field.GUARDIAN_HEARTBEAT_NS, 0)
        self._log = folder.guardian_log
        with ExitStack() as stack:
            watched = []
            if loop is not None:
                watched.append(os.pidfd_open(loop))
                stack.callback(os.close, watched[0])
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "hilctl.run.guardian"),
                    *(str(folder.guardian_job), str(watched[0]) if watched else "act"),
                ],
                stdin=subprocess.DEVNULL,
                # Not those of the supervisor: what reads them would wait for the guardian's end.
                stdout=subprocess.DEVNULL,
                stderr=stack.enter_context(self._log.open("wb")),
                start_new_session=True,
                pass_fds=(*inherits, *watched),
            )

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

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
        """Time of its last heartbeat, monotonic; 0 before the first."""
        return self._page.get(Field.GUARDIAN_HEARTBEAT_NS)

    @property
    def error(self) -> str:
        """Why it could not start or go on."""
        if self.phase == GuardianPhase.FAILED:
            return self._page.read_text(PageText.GUARDIAN)
        with suppress(OSError):
            *_, last = self._log.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
            return f"it died: {last}" if last else "it died"
        return "it died"

    def kill(self, wait_s: float = _DEATH_S) -> None:
        """Kill it.

        Args:
            wait_s: Longest wait until it is gone.
        """
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)

    def end(self) -> None:
        """Let it end by itself, as it does when the loop has; not for long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
            return
        self.kill()


def write_guardian_job(checked: Checked, folder: RunFolder, loop: int) -> None:
    """Write what the guardian of a run needs to know into the run's folder.

    A file and not a pipe, which could block the supervisor.

    Args:
        checked: The experiment.
        folder: The run's folder, with its ring.
        loop: Process number of the loop.

    Raises:
        OSError: It cannot be written.
    """
    loaded = checked.loaded
    limits = loaded.config.command_limits()
    job = GuardianJob(
        experiment=loaded.yaml_text,
        files=loaded.files.texts,
        folder=str(loaded.folder.resolve()),
        ring=str(folder.ring),
        safe_value=limits.safe,
        ramp_per_s=limits.ramp_per_s,
        limits=silence_limits(checked),
        loop=loop,
        supervisor=os.getpid(),
        priority=safe_priority(checked),
    )
    folder.guardian_job.write_text(job.to_json(), encoding="utf-8")


class GuardianRelief:
    """Takes devices over from the guardians that still drive them, after the end of their runs.

    Args:
        holds: What the devices hold alone, as :attr:`hilctl.base.device.DeviceInfo.holds`.

    Attributes:
        runs: The runs whose guardians were stopped.
    """

    def __init__(self, holds: Sequence[str]) -> None:
        self.runs = [
            run
            for run in (runs() if holds else [])
            if set(holds) & set(run.card.holds) and safe_result_of(run)
        ]
        for run in self.runs:
            signal_guardian(run, signal.SIGKILL, _END_S)

    def resume(self, inherits: Sequence[int]) -> None:
        """Start them again: the devices have not been driven to a safe value meanwhile.

        Args:
            inherits: Descriptors of the devices' locks.
        """
        for run in self.runs:
            try:
                with locked_run(run) as lock:
                    GuardianProcess(run, SampleRing(run.ring).page, [*inherits, lock], None)
            except (OSError, ValueError) as error:
                _log.error("the guardian of %s cannot be started again: %s", run.card.name, error)

    def discard(self) -> None:
        """Remove their folders: another process drives the devices."""
        for run in self.runs:
            with suppress(OSError, ValueError):
                if SampleRing(run.ring, look_only=True).page.get(Field.RECORDED):
                    run.remove()


def signal_guardian(run: RunFolder, number: int, wait_s: float = 0.0) -> bool:
    """Send a signal to the guardian of a run; return whether there was one.

    Args:
        run: The run.
        number: The signal.
        wait_s: Longest wait for its end.
    """
    try:
        guardian = os.pidfd_open(SampleRing(run.ring, look_only=True).page.get(Field.GUARDIAN_PID))
    except (OSError, ValueError):
        return False  # it has just ended
    try:
        # After the process was opened: while it holds the lock, the number is no other's.
        if not run.alive:
            return False
        signal.pidfd_send_signal(guardian, number)
        select.select([guardian], [], [], wait_s)
    except ProcessLookupError:
        return False
    finally:
        os.close(guardian)
    return True
