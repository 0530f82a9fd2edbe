"""Suspend of the computer: inhibited during a run, and detected.

A suspended loop commands nothing, but its device keeps the output. CLOCK_MONOTONIC stops meanwhile,
so no tick is late afterwards; CLOCK_BOOTTIME continues.
"""

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

SYSTEMD = "/run/systemd/system"
"""Exists if systemd runs this computer."""
SUSPEND_REMEDY = "sudo systemctl mask sleep.target"
_INHIBIT = (
    "systemd-inhibit",
    "--what=sleep:handle-lid-switch",
    "--who=hilctl",
    "--why=a run drives an actuator",
    "--mode=block",
    "cat",  # until its input is closed, also by the end of this process
)
_SHORTEST_NS = 10_000_000


def _boot_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class SuspendDetector:
    """Time the computer was suspended since the start, from two clocks in ns."""

    def __init__(
        self,
        boot_ns: Callable[[], int] = _boot_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._boot_ns, self._monotonic_ns = boot_ns, monotonic_ns
        self._before_ns = self._apart_ns()

    def _apart_ns(self) -> int:
        # In this order a pause between the two calls does not look like a suspend.
        return self._boot_ns() - self._monotonic_ns()

    def suspended_s(self) -> float:
        """Return the time suspended, in s; 0.0 if it was not."""
        suspended_ns = self._apart_ns() - self._before_ns
        return suspended_ns * 1e-9 if suspended_ns >= _SHORTEST_NS else 0.0


class SuspendInhibitor:
    """Lock of logind against suspend, held until closed or the end of this process."""

    def __init__(
        self, *, needed: bool, command: tuple[str, ...] = _INHIBIT, systemd: str = SYSTEMD
    ) -> None:
        self._process: subprocess.Popen[str] | None = None
        if not needed or not Path(systemd).is_dir():
            return
        pipe = subprocess.PIPE
        with suppress(FileNotFoundError):
            # Not in the terminal's group: Ctrl-C must not end it before the run.
            self._process = subprocess.Popen(
                command, stdin=pipe, stderr=pipe, text=True, start_new_session=True
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.communicate()

    def refusal(self) -> str:
        """Return why logind refused the lock; empty while it is held, or not needed."""
        if self._process is None or self._process.poll() is None:
            return ""
        return self._process.communicate()[1].strip() or "refused"
