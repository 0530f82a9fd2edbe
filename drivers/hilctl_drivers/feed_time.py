"""How often a watchdog must be fed, and what it costs where exchanges don't feed it.

A strict one has feed steps of its own, sent three times in its time-out. The ticks in which that
happens must fit in a sample period like all others.
"""

from dataclasses import replace

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.pdu import coil_pdu, read_pdu, write_pdu, write_single_pdu
from hilctl_drivers.modbus.profile import ModbusProfile, ModbusWatchdog
from hilctl_drivers.modbus.steps import EnsureStep, ExpectStep, ModbusStep
from hilctl_drivers.profile_parts import WaitStep
from hilctl_drivers.text.profile import (
    AsciiProfile,
    AsciiStep,
    AsciiWatchdog,
    AskStep,
    NumberStep,
)
from hilctl_drivers.wire_time import Line, Profile, WireTime, lines_time, requests_time

_FEEDS_A_TIMEOUT = 3.0


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


def feed_time(profile: Profile) -> WireTime | None:
    """Return what it costs to feed the device's watchdog once; None where exchanges feed it.

    A step that writes only what differs counts as one that writes.
    """
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    if isinstance(profile, ModbusProfile) and isinstance(watchdog, ModbusWatchdog):
        requests = [pdu for step in watchdog.feed for pdu in _requests(profile, step)]
        return _with_waits(requests_time(profile, requests), watchdog.feed)
    if isinstance(profile, AsciiProfile) and isinstance(watchdog, AsciiWatchdog):
        lines = [line for step in watchdog.feed for line in _lines(profile, watchdog, step)]
        return _with_waits(lines_time(profile, lines), watchdog.feed)
    return None


def with_feeding(exchange: WireTime, profile: Profile) -> WireTime:
    """Return what a tick costs that feeds the device's watchdog, where ticks do."""
    feed = feed_time(profile)
    return exchange if feed is None else exchange.then(feed)


def _with_waits(time: WireTime, steps: tuple[ModbusStep, ...] | tuple[AsciiStep, ...]) -> WireTime:
    waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
    return replace(
        time,
        what=f"{time.what} to feed the watchdog",
        gaps=time.gaps + len(waits_s),
        gaps_s=time.gaps_s + sum(waits_s),
    )


def _requests(profile: ModbusProfile, step: ModbusStep) -> list[bytes]:
    """Return the requests of a step, with the longest that it may come to."""
    if isinstance(step, WaitStep):
        return []
    address, data = profile.wire_address(step), bytes(2 * step.words)
    read = read_pdu(step.read_function, address, step.words)
    if isinstance(step, ExpectStep):
        return [read]
    if step.type == "bit":
        write = coil_pdu(address, True)
    else:
        write = (write_single_pdu if step.words == 1 else write_pdu)(address, data)
    if isinstance(step, EnsureStep):
        return [read, write, read]
    return [write, read] if step.verify else [write]


def _lines(profile: AsciiProfile, watchdog: AsciiWatchdog, step: AsciiStep) -> list[Line]:
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
