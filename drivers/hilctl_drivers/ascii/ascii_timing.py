"""How long lines of text take, and feeding a watchdog where exchanges don't."""

from collections.abc import Sequence
from typing import TypeAlias

from hilctl_drivers.ascii.ascii_profile import (
    AsciiInput,
    AsciiProfile,
    AsciiStep,
    AsciiWatchdog,
    AskStep,
    NumberStep,
)
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport.wire_time import WireTime

Line: TypeAlias = tuple[str, str | None]
"""What is sent, and an example of its reply; None where it is not answered."""

_CHECKSUM_CHARS = {"none": 0, "dcon": 2, "gen": 3}


def exchange_time(
    profile: AsciiProfile, output: str, sensor: str | None, *, one_transaction: bool = True
) -> WireTime:
    """Return what one exchange costs: set an output, with the longest value, and ask for an input.

    Args:
        profile: The device; see :func:`hilctl_drivers.profile.with_link` for another baud.
        output: Name of the output.
        sensor: Name of the input; None to write only.
        one_transaction: Whether the exchange in one line may be used, where there is one.

    Raises:
        KeyError: No such output or input.
    """
    channel = profile.outputs[output]
    address = 0 if profile.address == "none" else profile.address

    def longest(template: str) -> str:
        texts = (template.format(value=v, address=address) for v in channel.limits)
        return max(texts, key=len)

    settle_s = channel.settle_s + (profile.inputs[sensor].settle_s if sensor else 0.0)
    combined = profile.exchange
    pair = (output, sensor)
    if one_transaction and combined != "none" and (combined.output, combined.input) == pair:
        return lines_time(profile, [(longest(combined.write), combined.example)], settle_s)
    answer = None if channel.reply == "none" else channel.reply.example
    lines: list[Line] = [(longest(channel.write), answer)]
    if sensor is not None:
        source = profile.inputs[sensor]
        lines.append((source.ask.format(address=address), source.example))
    return lines_time(profile, lines, settle_s)


def query_time(profile: AsciiProfile, query: AsciiInput, address: int, what: str) -> WireTime:
    """Return what a question costs that stands beside the exchange.

    Args:
        profile: The device that is asked, with the settings of the line that it stands on.
        query: The input that is asked for.
        address: The device's address.
        what: What it is for, in words.
    """
    lines = [(query.ask.format(address=address), query.example)]
    return lines_time(profile, lines, query.settle_s).named(what)


def feed_time(profile: AsciiProfile) -> WireTime | None:
    """Return what it costs to feed the device's watchdog once; None where exchanges feed it."""
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    lines = [line for step in watchdog.feed for line in _step_lines(profile, watchdog, step)]
    waits_s = [step.seconds for step in watchdog.feed if isinstance(step, WaitStep)]
    return lines_time(profile, lines).feeding(waits_s)


def arm_s(profile: AsciiProfile, output: str) -> float:
    """Return how long arming the device's watchdog takes at most, s; 0 without a watchdog."""
    watchdog = profile.watchdog
    if watchdog == "none":
        return 0.0
    steps = (*watchdog.safe.get(output, ()), *watchdog.arm)
    lines = [line for step in steps for line in _step_lines(profile, watchdog, step)]
    if profile.error_query != "none":
        lines.append((profile.error_query.ask, profile.error_query.example))
    waits_s = sum(step.seconds for step in steps if isinstance(step, WaitStep))
    return lines_time(profile, lines).answered_s + waits_s


def lines_time(profile: AsciiProfile, lines: Sequence[Line], settle_s: float = 0.0) -> WireTime:
    """Return what lines cost with their replies, one after the other."""
    link = profile.link
    check = _CHECKSUM_CHARS[link.checksum]
    sent = sum(len(line) + check + len(link.terminator) for line, _ in lines)
    replies = [reply for _, reply in lines if reply is not None]
    received = sum(len(reply) + check + len(link.reply_terminator) for reply in replies)
    return WireTime(
        f"{len(lines)} {'line' if len(lines) == 1 else 'lines'} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        len(lines),
        len(lines) * link.min_gap_s,
        len(replies) * profile.turnaround_s,
        settle_s=settle_s,
    )


def _step_lines(profile: AsciiProfile, watchdog: AsciiWatchdog, step: AsciiStep) -> list[Line]:
    """Return the lines of a step, none or one."""
    if isinstance(step, WaitStep):
        return []
    values = {
        "address": 0 if profile.address == "none" else profile.address,
        "timeout": int(watchdog.max_s / watchdog.unit_s),
        "safe": 0.0,
    }
    if isinstance(step, AskStep | NumberStep):
        return [(step.ask.format(**values), step.example)]
    reply = None if step.reply == "none" else step.reply.example
    return [(step.text.format(**values), reply)]
