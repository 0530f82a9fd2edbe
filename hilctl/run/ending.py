"""What a recording says of its run's end: the loop's own account and the exact counters."""

from hilctl.loop.pacer import Lateness
from hilctl.loop.plan import Outcome


def end_facts(outcome: Outcome, lateness: Lateness, lost_events: int = 0) -> dict[str, str]:
    """Return the facts of a run's end, as text."""
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "late_ticks": str(lateness.late_ticks),
        "skipped_ticks": str(lateness.skipped_ticks),
        "worst_late_ns": str(lateness.worst_ns),
        "worst_late_tick": str(lateness.worst_tick),
        "longest_late_run": str(lateness.longest_run),
        "dropped_in_ring": str(outcome.dropped),
        "lost_events": str(lost_events),
    }
