"""The guardian's process as the supervisor has it: started, looked at, ended.

What it does is in :mod:`hilctl.run.guardian`, which imports as little as can be.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress

from hilctl.experiment.check import Checked
from hilctl.run.guardian import GuardianJob
from hilctl.run.hang_watch import SilenceLimits
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, GuardianPhase, PageText, SharedPage

_END_S = 1.0
_SIMULATED_MARGIN_S = 0.5
_HANG_S = 0.08
_STOPPED_S = 0.02


def silence_limits(checked: Checked) -> SilenceLimits:
    """Return how long the loop of an experiment may be silent."""
    config = checked.loaded.config
    timing = config.timing
    simulated = checked.loaded.device.info.simulated
    hang_s = timing.hang_s
    if hang_s is None:
        hang_s = timing.max_late_s + _SIMULATED_MARGIN_S if simulated else _HANG_S
    periods_s = 2.0 * config.tick_s
    return SilenceLimits(
        loop_s=periods_s + hang_s,
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
        job: What it guards.
        folder: The run's folder.
        page: Shared with it.
        inherits: Descriptors of locks that it is to hold.

    Raises:
        OSError: It can't be started.
    """

    def __init__(
        self, job: GuardianJob, folder: RunFolder, page: SharedPage, inherits: Sequence[int]
    ) -> None:
        self._page = page
        # A file and not a pipe: a pipe could keep the supervisor waiting.
        folder.guardian_job.write_text(job.to_json(), encoding="utf-8")
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.STARTING)
        page.put(Field.GUARDIAN_HEARTBEAT_NS, 0)
        loop = os.pidfd_open(job.loop)
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "hilctl.run.guardian"),
                    *(str(folder.guardian_job), str(loop)),
                ],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                pass_fds=(*inherits, loop),
            )
        finally:
            os.close(loop)

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
        """When it gave a sign last, monotonic time; 0 where it never did."""
        return self._page.get(Field.GUARDIAN_HEARTBEAT_NS)

    @property
    def error(self) -> str:
        """Why it could not start."""
        return self._page.read_text(PageText.GUARDIAN) or "it died"

    def kill(self, wait_s: float | None = None) -> None:
        """End it at once.

        Args:
            wait_s: Longest wait until it is gone; None for as long as that takes.
        """
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)

    def end(self) -> None:
        """Let it end by itself, as it does once the loop has; not for long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
            return
        self.kill()


def guardian_of(
    checked: Checked, folder: RunFolder, page: SharedPage, loop: int, inherits: Sequence[int]
) -> Callable[[], GuardianProcess]:
    """Return what starts the guardian of a run, any number of times.

    Args:
        checked: The experiment.
        folder: The run's folder, with its ring.
        page: The ring's page.
        loop: Process number of the loop.
        inherits: Descriptors of locks that the guardian is to hold.
    """
    loaded = checked.loaded
    job = GuardianJob(
        experiment=loaded.yaml_text,
        files=loaded.files.texts,
        folder=str(loaded.folder.resolve()),
        ring=str(folder.ring),
        safe_value=loaded.config.safe.value,
        limits=silence_limits(checked),
        loop=loop,
        priority=safe_priority(checked),
    )
    return lambda: GuardianProcess(job, folder, page, inherits)
