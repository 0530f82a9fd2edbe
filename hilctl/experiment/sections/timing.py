"""The ``timing`` section: late ticks, deadline misses, and the silence of a hung loop.

The guardian imports this module, so it must not import numba.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from hilctl.base.device import DeviceInfo
from hilctl.base.strict import Field, StrictModel
from hilctl.loop.pacer import USUAL_MISSED_SHARE, LatePolicy, LateRules

SHORTEST_TICK_S = 1e-4
"""Shortest tick that timers keep on most machines: an idle CPU takes up to 0.1 ms to wake."""
_ALWAYS_LATE_S = 2.0
_MISSED_WINDOW_S = 10.0
_SIMULATED_MARGIN_S = 0.5
_HANG_SHARE = 0.08  # of max_late_s, 1 s by default
_STOPPED_S = 0.02


class Timing(StrictModel):
    """Policy for late ticks.

    A device paced by the host skips whole ticks in the waveform, and keeps the phase. A device with
    its own sample clock catches up, because its FIFO takes the burst. Late ticks over two seconds
    end the run.

    Attributes:
        late_after: Delay in tick periods after which a tick counts as late.
        max_late_s: A tick later than this ends the run.
            So does a longer silence of the loop: it is killed, and the output set to the safe
            value. With real-time priority and a coil to protect the silence is at most 80 ms, or
            8 % of ``max_late_s`` if that is more, and 20 ms of a stopped process (SIGSTOP).
            ``max_late_s`` is added while the loop waits for the device.
        max_missed_share: Largest share of skipped ticks, over ten seconds or the whole waveform if
            that is shorter; more end the run with its safe ramp, but fewer than five stalls never
            do. The command is constant in a skipped tick and jumps after it, so the output is no
            longer the checked waveform. 1: any number is only reported.
    """

    REMOVED: ClassVar[Mapping[str, str]] = {
        "late_policy": "removed: late ticks are skipped; delete the key",
        "max_consecutive_late": "removed: two seconds of late ticks end a run; set late_after",
        "grace_s": "removed: set max_missed_share: 1, or a larger max_late_s",
        "on_misses": "removed: set max_missed_share: 1 instead of warn; fault is the default",
        "hang_s": "removed: set max_late_s, from which it follows",
    }

    late_after: Annotated[float, Field(gt=0.0)] = 0.5
    max_late_s: Annotated[float, Field(gt=0.0)] = 1.0
    max_missed_share: Annotated[float, Field(ge=0.0, le=1.0)] = USUAL_MISSED_SHARE


@dataclass(frozen=True, slots=True)
class SilenceLimits:
    """Longest silence of the loop before it counts as hung."""

    real_time_s: float  # with real-time priority
    ordinary_s: float  # without real-time priority, on a busy computer
    exchange_s: float  # added while it waits for the device
    stopped_s: float  # while its process is stopped, such as by SIGSTOP


def timeout_warnings(timing: Timing, timeout_s: object) -> tuple[str, ...]:
    """Return a warning if the device's timeout exceeds the time that a run waits for an answer."""
    limit_s = timing.max_late_s
    if not isinstance(timeout_s, int | float) or timeout_s <= limit_s:
        return ()
    return (
        f"device.timeout_s: {timeout_s:g} s is longer than timing.max_late_s, {limit_s:g} s, but "
        "an exchange that takes longer than max_late_s ends the run. Lower timeout_s, or raise "
        "max_late_s.",
    )


def pace_warnings(tick_s: float, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if many ticks will be late; none for a device with its own clock."""
    if info.latency_blocks or tick_s >= SHORTEST_TICK_S:
        return ()
    remedy = "Use a larger block." if info.buffered else "Use a lower rate."
    return (
        f"sample_rate_hz: {1.0 / tick_s:g} ticks per second: on most machines timers wake "
        f"the loop too late for some of them. {remedy}",
    )


def late_policy(info: DeviceInfo) -> LatePolicy:
    """Return what follows a late tick with a device."""
    if info.latency_blocks:
        return "follow"
    return "catch_up" if info.buffered else "skip"


def late_rules(timing: Timing, tick_s: float, ticks: int) -> LateRules:
    """Return the rules on late ticks for a waveform of so many ticks."""
    window = min(round(_MISSED_WINDOW_S / tick_s), ticks)
    return LateRules(
        late_after_ns=timing.late_after * tick_s * 1e9,
        max_late_ns=timing.max_late_s * 1e9,
        max_consecutive_late=math.ceil(_ALWAYS_LATE_S / tick_s),
        missed_window=max(1, window),
        max_missed=timing.max_missed_share * window,
    )


def silence_limits(timing: Timing, tick_s: float, *, simulated: bool) -> SilenceLimits:
    """Return the longest silence of the loop of an experiment."""
    # Without real-time priority the loop may be as late as its own limit allows.
    ordinary_s = hang_s = timing.max_late_s + (_SIMULATED_MARGIN_S if simulated else 0.0)
    if not simulated:
        hang_s = min(_HANG_SHARE * max(timing.max_late_s, 1.0), ordinary_s)
    periods_s = 2.0 * tick_s
    return SilenceLimits(
        real_time_s=periods_s + hang_s,
        ordinary_s=periods_s + ordinary_s,
        # An exchange that takes longer makes the next tick too late, which ends the run as well.
        # Not the device's timeout, which may be long: until the answer the output stays driven.
        exchange_s=timing.max_late_s,
        # A stopped simulated loop may be under a debugger; no device needs protection.
        stopped_s=periods_s + (hang_s if simulated else min(hang_s, _STOPPED_S)),
    )
