"""Whether ticks come as fast as no timer wakes a loop for them."""

from hilctl.base.device import DeviceInfo
from hilctl.experiment.file import Experiment

FASTEST_SLEEPING_S = 1e-4
"""Shortest period of a tick that a loop which sleeps keeps on most machines: an idle CPU takes from
a few us to a tenth of a millisecond to wake."""


def pace_warnings(config: Experiment, info: DeviceInfo) -> tuple[str, ...]:
    """Return what would keep many ticks late, and what to do about it.

    Args:
        config: The experiment.
        info: What its device says of itself: one that plays blocks from a FIFO keeps the pace.
    """
    sleeps = config.realtime.wait == "sleep" and not info.latency_blocks
    if not sleeps or config.tick_s >= FASTEST_SLEEPING_S:
        return ()
    rate = f"{1.0 / config.tick_s:g} ticks a second"
    longer = ", or a larger block" if info.buffered else ""
    why = "on most machines timers wake a loop too late for that, now and then"
    return (f"realtime.wait: {rate}: {why}; realtime.wait: spin is in time{longer}",)
