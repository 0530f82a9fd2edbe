"""How it is seen that the loop hangs: it lives, but its heartbeat stands still."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hilctl.run.shared_page import Field, Phase, SharedPage

_POLLS = 3
_CLOSING_S = 30.0


@dataclass(frozen=True, slots=True)
class SilenceLimits:
    """How long the loop may be silent.

    Attributes:
        real_time_s: While it runs with real-time priority.
        ordinary_s: While it runs without: a busy machine may keep it waiting for so long.
        exchange_s: What is added while it waits for the device.
        stopped_s: While its process is stopped, as by SIGSTOP: it waits for nothing that could
            come, and it is no busy machine that keeps it.
    """

    real_time_s: float
    ordinary_s: float
    exchange_s: float
    stopped_s: float


class HangWatch:
    """Looks at the loop's heartbeat.

    Where the whole machine stands still, this process does too: silence counts only where this side
    has looked several times meanwhile.

    Args:
        page: Shared with the loop.
        limits: Longest that it may be silent.
        is_stopped: Whether the loop's process is stopped.
    """

    def __init__(
        self, page: SharedPage, limits: SilenceLimits, is_stopped: Callable[[], bool]
    ) -> None:
        self._page = page
        self._limits = limits
        self._is_stopped = is_stopped
        self._heartbeat_ns = -1
        self._seen_ns = 0
        self._polls = 0

    def hangs(self, now_ns: int) -> bool:
        """Look once; return whether the loop has been silent for too long.

        Args:
            now_ns: Monotonic time.
        """
        page = self._page
        heartbeat_ns, phase = page.get(Field.LOOP_HEARTBEAT_NS), page.get(Field.PHASE)
        watched = phase in {Phase.RUNNING, Phase.CLOSING}
        if heartbeat_ns != self._heartbeat_ns or not watched:
            self._heartbeat_ns, self._seen_ns, self._polls = heartbeat_ns, now_ns, 0
            return False
        self._polls += 1
        silent_s = (now_ns - self._seen_ns) * 1e-9
        if self._polls <= _POLLS:
            return False
        limits = self._limits
        loop_s = limits.real_time_s if page.get(Field.REAL_TIME) else limits.ordinary_s
        if silent_s > loop_s + self._wait_s(phase):
            return True
        # Last, since it asks the kernel.
        return silent_s > limits.stopped_s and self._is_stopped()

    def _wait_s(self, phase: int) -> float:
        """Return how long the loop may be waiting for its device."""
        # A device that is lost may use up its time-outs; and before the first tick nothing moves.
        if phase == Phase.CLOSING or not self._page.get(Field.LOOP_HEARTBEAT_NS):
            return _CLOSING_S
        return self._limits.exchange_s if self._page.get(Field.EXCHANGING) else 0.0


def is_stopped(process: int) -> bool:
    """Return whether a process is stopped or traced; of one that is gone, False."""
    try:
        stat = Path(f"/proc/{process}/stat").read_bytes()
    except OSError:
        return False
    # Behind the program's name, which may have spaces and brackets of its own.
    return stat.rpartition(b")")[2].split()[0] in {b"T", b"t"}
