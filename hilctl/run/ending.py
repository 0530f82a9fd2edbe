"""What a recording says of its run's end: the loop's own account and the exact counters."""

from hilctl.loop.plan import Outcome
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field


def end_facts(outcome: Outcome, ring: SampleRing) -> dict[str, str]:
    """Return the facts of a run's end, as text."""
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "late_ticks": str(ring.get(Field.LATE_TICKS)),
        "skipped_ticks": str(ring.get(Field.SKIPPED_TICKS)),
        "worst_late_ns": str(ring.get(Field.WORST_LATE_NS)),
        "worst_late_tick": str(ring.get(Field.WORST_LATE_TICK)),
        "longest_late_run": str(ring.get(Field.LONGEST_LATE_RUN)),
        "dropped_in_ring": str(outcome.dropped),
        "lost_events": str(ring.get(Field.EVENTS_LOST)),
    }
