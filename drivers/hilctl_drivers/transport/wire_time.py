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
    """What an exchange costs.

    Attributes:
        what: Requests and line, like ``FC23 at 115200 8N1``.
        request_s: Characters of all requests.
        reply_s: Characters of all replies.
        gaps: Number of gaps.
        gaps_s: All gaps together.
        turnaround_s: The device's, all requests together.
        samples: Samples that one exchange carries.
        settle_s: Time that output and input take to settle.
    """

    what: str
    request_s: float
    reply_s: float
    gaps: int
    gaps_s: float
    turnaround_s: float
    samples: int = 1
    settle_s: float = 0.0

    @property
    def answered_s(self) -> float:
        """Time until the last reply is there, s."""
        return self.request_s + self.reply_s + self.gaps_s + self.turnaround_s

    @property
    def total_s(self) -> float:
        """Time of one exchange, until the next one can begin, s."""
        return self.answered_s + self.settle_s

    @property
    def highest_rate_hz(self) -> float:
        """Highest sample rate that the wire and the device leave."""
        return self.samples / self.total_s if self.total_s > 0.0 else float("inf")

    def then(self, other: "WireTime | None") -> "WireTime":
        """Return what this and then ``other`` cost, for the samples of this."""
        if other is None:
            return self
        return WireTime(
            f"{self.what}, then {other.what}",
            self.request_s + other.request_s,
            self.reply_s + other.reply_s,
            self.gaps + other.gaps,
            self.gaps_s + other.gaps_s,
            self.turnaround_s + other.turnaround_s,
            self.samples,
            self.settle_s + other.settle_s,
        )

    def named(self, purpose: str) -> "WireTime":
        """Return this with what it is for."""
        return replace(self, what=f"{self.what} {purpose}")

    def waiting(self, waits_s: list[float]) -> "WireTime":
        """Return this with waits between its requests."""
        gaps_s = self.gaps_s + sum(waits_s)
        return replace(self, gaps=self.gaps + len(waits_s), gaps_s=gaps_s)

    def __str__(self) -> str:
        parts = []
        if self.request_s > 0.0:
            parts.append(f"request {self.request_s * 1e3:.2f} ms")
        if self.reply_s > 0.0:
            parts.append(f"reply {self.reply_s * 1e3:.2f} ms")
        if self.gaps_s > 0.0:
            name = "gap" if self.gaps == 1 else "gaps"
            parts.append(f"{self.gaps} {name} {self.gaps_s * 1e3:.2f} ms")
        parts.append(f"turnaround {self.turnaround_s * 1e3:.2f} ms")
        if self.settle_s > 0.0:
            parts.append(f"settling {self.settle_s * 1e3:.2f} ms")
        return f"{self.what}: {', '.join(parts)} -> at most {self.highest_rate_hz:.0f} Hz"


@dataclass(frozen=True, slots=True)
class RateLimit:
    """The sample rates that a device can keep.

    Attributes:
        highest_hz: Highest sample rate.
        note: Why it is that, as text.
        lowest_hz: Lowest sample rate; 0 if any above 0 will do.
    """

    highest_hz: float
    note: str
    lowest_hz: float = 0.0

    @classmethod
    def of(cls, wire: WireTime, most_hz: float, whose: str, lowest_hz: float = 0.0) -> "RateLimit":
        """Return the limit of the wire or of the device, whichever is lower.

        Args:
            wire: Time of an exchange.
            most_hz: Highest rate of the device itself.
            whose: Source of that rate.
            lowest_hz: Lowest sample rate.
        """
        if wire.highest_rate_hz <= most_hz:
            return cls(wire.highest_rate_hz, str(wire), lowest_hz)
        return cls(most_hz, f"{whose} says so; the wire alone: {wire}", lowest_hz)

    def check(self, rate_hz: float) -> None:
        """Reject a sample rate outside the limits.

        Raises:
            DeviceError: What would be possible, and why.
        """
        if rate_hz > 0.0 and self.lowest_hz <= rate_hz <= self.highest_hz:
            return
        begin = f"[{self.lowest_hz:g}" if self.lowest_hz else "(0"
        note = f" ({self.note})" if self.note else ""
        raise DeviceError(
            f"sample rate must be in {begin}, {self.highest_hz:.6g}] Hz{note}, got {rate_hz:g}"
        )


def check_feeds(timeout_s: float | None, ticks_per_s: float) -> int:
    """Return how many ticks come in a third of the watchdog's timeout; 0 without a watchdog.

    Raises:
        DeviceError: Less than one.
    """
    if timeout_s is None:
        return 0
    ticks = timeout_s * ticks_per_s / _FEEDS_A_TIMEOUT
    if ticks < 1.0:
        rule = f"{_FEEDS_A_TIMEOUT:g} exchanges must come within the watchdog's timeout"
        raise DeviceError(f"{rule}, {timeout_s:g} s, got {ticks_per_s:g} a second")
    return int(ticks)
