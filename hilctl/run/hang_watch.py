"""How the supervisor sees that the loop hangs: it lives, but its heartbeat stands still."""

from hilctl.run.shared_page import Field, Phase, SharedPage

_POLLS = 5
_CLOSING_S = 30.0


class HangWatch:
    """Looks at the loop's heartbeat.

    Where the whole machine stands still, this process does too: silence counts only where this side
    has looked several times meanwhile.

    Args:
        page: Shared with the loop.
        limit_s: Longest that it may be silent while it runs.
    """

    def __init__(self, page: SharedPage, limit_s: float) -> None:
        self._page = page
        self._limit_ns = limit_s * 1e9
        self._heartbeat_ns = 0
        self._seen_ns = 0
        self._polls = 0

    def hangs(self, now_ns: int) -> bool:
        """Look once; return whether the loop has been silent for too long.

        Args:
            now_ns: Monotonic time.
        """
        heartbeat_ns = self._page.get(Field.LOOP_HEARTBEAT_NS)
        phase = self._page.get(Field.PHASE)
        watched = phase in {Phase.RUNNING, Phase.CLOSING}
        if heartbeat_ns != self._heartbeat_ns or not watched or heartbeat_ns == 0:
            self._heartbeat_ns, self._seen_ns, self._polls = heartbeat_ns, now_ns, 0
            return False
        self._polls += 1
        limit_ns = self._limit_ns
        if phase == Phase.CLOSING:  # a device that is lost may use up its time-outs
            limit_ns += _CLOSING_S * 1e9
        return self._polls > _POLLS and now_ns - self._seen_ns > limit_ns
