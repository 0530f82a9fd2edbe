"""Duration of an exchange on a wire, and the highest sample rate; independent of the protocol.

It is a lower bound: characters at the line's baud, gaps that the protocol or the device requires,
USB frames, the device's turnaround, and the settling time of its terminals. Delays of the operating
system are not included. So a rejected rate is impossible, and an accepted one may still be too
high. Each protocol computes its own messages.
"""

from dataclasses import dataclass, replace

from hilctl.base.errors import DeviceError

_FEEDS_A_TIMEOUT = 3.0


@dataclass(frozen=True, slots=True)
class WireTime:
    """The duration of an exchange; each part is the sum over all requests."""

    what: str  # requests and line, like ``FC23 at 115200 8N1``
    request_s: float
    reply_s: float
    gaps: int
    gaps_s: float
    turnaround_s: float
    samples: int = 1  # samples of one exchange
    settle_s: float = 0.0

    @property
    def answered_s(self) -> float:
        """Time until the last reply, s."""
        return self.request_s + self.reply_s + self.gaps_s + self.turnaround_s

    @property
    def total_s(self) -> float:
        """Time of one exchange, until the next one can begin, s."""
        return self.answered_s + self.settle_s

    @property
    def highest_rate_hz(self) -> float:
        """Highest sample rate that the wire and the device allow."""
        return self.samples / self.total_s if self.total_s > 0.0 else float("inf")

    def then(self, other: "WireTime | None") -> "WireTime":
        """Return the duration of both in sequence, for the samples of this one."""
        if other is None:
            return self
        parts = ("request_s", "reply_s", "gaps", "gaps_s", "turnaround_s", "settle_s")
        sums = {name: getattr(self, name) + getattr(other, name) for name in parts}
        return replace(self, what=f"{self.what}, then {other.what}", **sums)

    def named(self, purpose: str) -> "WireTime":
        """Return this with its purpose."""
        return replace(self, what=f"{self.what} {purpose}")

    def waiting(self, waits_s: list[float]) -> "WireTime":
        """Return this with waits between its requests."""
        gaps_s = self.gaps_s + sum(waits_s)
        return replace(self, gaps=self.gaps + len(waits_s), gaps_s=gaps_s)

    def __str__(self) -> str:
        durations_s = {
            "request": self.request_s,
            "reply": self.reply_s,
            f"{self.gaps} gaps" if self.gaps > 1 else "gap": self.gaps_s,
            "turnaround": self.turnaround_s,
            "settling": self.settle_s,
        }
        parts = ", ".join(
            f"{name} {seconds * 1e3:.2f} ms"
            for name, seconds in durations_s.items()
            if seconds > 0.0 or name == "turnaround"
        )
        return f"{self.what}: {parts}"


@dataclass(frozen=True, slots=True)
class RateLimit:
    """The sample rates that a device can keep, and the reason for the highest one."""

    highest_hz: float
    note: str
    lowest_hz: float = 0.0

    @classmethod
    def of(cls, wire: WireTime, most_hz: float, whose: str, lowest_hz: float = 0.0) -> "RateLimit":
        """Return the limit of the wire, or that of the device (from ``whose``) if it is lower."""
        if wire.highest_rate_hz <= most_hz:
            return cls(wire.highest_rate_hz, str(wire), lowest_hz)
        alone = f"{wire} -> at most {wire.highest_rate_hz:.4g} Hz"
        return cls(most_hz, f"{whose} says so; the wire alone: {alone}", lowest_hz)

    def check(self, rate_hz: float) -> None:
        """Raise DeviceError for a sample rate outside the limits."""
        if rate_hz > 0.0 and self.lowest_hz <= rate_hz <= self.highest_hz:
            return
        begin = f"[{self.lowest_hz:g}" if self.lowest_hz else "(0"
        note = f" ({self.note})" if self.note else ""
        raise DeviceError(
            f"sample rate must be in {begin}, {self.highest_hz:.6g}] Hz{note}, got {rate_hz:g}"
        )


def check_feeds(timeout_s: float | None, ticks_per_s: float) -> int:
    """Return the ticks in a third of the watchdog's timeout, at least 1; 0 without a watchdog."""
    if timeout_s is None:
        return 0
    ticks = timeout_s * ticks_per_s / _FEEDS_A_TIMEOUT
    if ticks < 1.0:
        rule = f"{_FEEDS_A_TIMEOUT:g} exchanges must come within the watchdog's timeout"
        raise DeviceError(f"{rule}, {timeout_s:g} s, got {ticks_per_s:g} a second")
    return int(ticks)
