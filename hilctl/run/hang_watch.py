"""How the supervisor sees that the loop hangs: it lives, but gives no sign of life."""

from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase

_POLLS = 5
_CLOSING_S = 30.0


class HangWatch:
    """Looks at the loop's heartbeat.

    Where the whole machine stands still, this process does too: silence counts only where this side
    has looked several times meanwhile.

    Args:
        ring: Shared with the loop.
        limit_s: Longest that it may be silent while it runs.
    """

    def __init__(self, ring: SampleRing, limit_s: float) -> None:
        self._ring = ring
        self._limit_ns = limit_s * 1e9
        self._beat_ns = 0
        self._seen_ns = 0
        self._polls = 0

    def hangs(self, now_ns: int) -> bool:
        """Look once; return whether the loop has been silent for too long.

        Args:
            now_ns: Monotonic time.
        """
        beat_ns = self._ring.get(Field.LOOP_BEAT_NS)
        phase = self._ring.get(Field.PHASE)
        watched = phase in {Phase.RUNNING, Phase.CLOSING}
        if beat_ns != self._beat_ns or not watched or beat_ns == 0:
            self._beat_ns, self._seen_ns, self._polls = beat_ns, now_ns, 0
            return False
        self._polls += 1
        limit_ns = self._limit_ns
        if phase == Phase.CLOSING:  # a device that is lost may use up its time-outs
            limit_ns += _CLOSING_S * 1e9
        return self._polls > _POLLS and now_ns - self._seen_ns > limit_ns
