"""Whether the ticks come faster than timers wake a loop."""

from hilctl.base.device import DeviceInfo
from hilctl.experiment.file import Experiment

SHORTEST_TICK_S = 1e-4
"""Shortest tick that timers keep on most machines: an idle CPU takes from a few us to a tenth of a
millisecond to wake."""


def pace_warnings(config: Experiment, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if many ticks will be late.

    Args:
        config: The experiment.
        info: What its device says of itself: one that plays blocks from a FIFO keeps the pace.
    """
    if info.latency_blocks or config.tick_s >= SHORTEST_TICK_S:
        return ()
    remedy = "Use a larger block." if info.buffered else "Use a lower rate."
    return (
        f"sample_rate_hz: {1.0 / config.tick_s:g} ticks per second: on most machines timers wake "
        f"the loop too late for some of them. {remedy}",
    )
