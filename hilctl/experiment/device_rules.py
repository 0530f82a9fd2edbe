"""The rules of the ``device`` section: rate, blocks, watchdog, channels and calibration."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from itertools import combinations
from typing import Any

from hilctl.base.axes import names_text
from hilctl.base.device import AuxChannel, Device, DeviceInfo, JointDevice
from hilctl.base.errors import ConfigProblem, DeviceError, broken
from hilctl.base.formatting import did_you_mean
from hilctl.experiment.rig import RunRig

_YEAR_DAYS = 366
_EPOCH = date(1970, 1, 1).toordinal()
_TIMEOUT_TICKS = 3  # that devices ask for when they are opened
_AUX_NAME = re.compile("[A-Za-z][A-Za-z0-9_]{0,62}")  # as MATLAB has it
TAKEN_AUX_NAMES = {
    "run", "end", "segments", "experiment_yaml", "model_yaml", "run_id", "name", "date",  # exports
    "reference", "displacement", "error", "command", "measured", "wanted", "slew",  # the live page
}  # fmt: skip
"""Names that a channel must not have, besides the columns of a recording."""


def calibration_warnings(info: DeviceInfo, now_s: float) -> tuple[str, ...]:
    """Return a warning for each calibration that is too old at a Unix time, or poor."""
    if info.calibration is None:
        return ()
    day = _EPOCH + now_s // 86400.0  # as date.toordinal, beyond its last year as well
    found = []
    for part, made in info.calibration.content.parts.items():
        again = f"Calibrate it again with 'hilctl calibrate {part}'."
        if day - made.date.toordinal() > _YEAR_DAYS:
            text = f"the {part} was calibrated on {made.date}, more than a year ago"
            found.append(f"device.calibration: {text}. {again}")
        if made.grade == "poor":
            text = f"the residual of the {part} is {made.residual_percent:.2g} % of its range"
            found.append(f"device.calibration: {text}. {again}")
    return tuple(found)


def rate_problems(device: Device, rate_hz: float, block: int) -> Iterator[ConfigProblem]:
    """Yield a rate or a block that the device does not support."""
    info = device.info
    if rate_hz > info.max_rate_hz:
        note = f" ({info.rate_note})" if info.rate_note else ""
        rule = f"must be <= {info.max_rate_hz:g}, the highest rate of {info.name}{note}"
        yield broken("sample_rate_hz", rule, str(rate_hz))
    if block > 1 and not info.buffered:
        rule = f"must be 1: {info.name} has no FIFO with a sample clock"
        yield broken("block", rule, str(block))
    blocks = max(2, info.latency_blocks + 1)
    if info.buffered and blocks * block > info.fifo_depth:
        fifo = f"the FIFO of {info.name}, {info.fifo_depth} samples"
        rule = f"must be <= {info.fifo_depth // blocks}: {blocks} blocks must fit into {fifo}"
        yield broken("block", rule, str(block))
    elif rate_hz <= info.max_rate_hz:
        try:
            device.check_rate(rate_hz, block)
        except DeviceError as error:
            rule = f"must allow sample_rate_hz, which a larger block does: {error}"
            yield broken("block", rule, str(block))


def watchdog_problems(rig: RunRig) -> Iterator[ConfigProblem]:
    """Yield a watchdog value other than the safe value, and a timeout shorter than the start."""
    info, safe = rig.info, rig.command.safe
    command, unit = info.watchdog_command, info.command_unit
    if command is not None and not math.isclose(command, safe, abs_tol=1e-9):
        low, high = rig.command.low, rig.command.high
        rule, hint = "", ""
        if not low <= command <= high:
            rule = f"must lie within the limits, {low:g} to {high:g} {unit}"
        elif not info.watchdog_reason:
            rule = f"must be the safe value, {safe:g} {unit}"
            hint = "or give the reason in device.watchdog.reason"
        if rule:
            yield broken("device.watchdog.safe_command", rule, f"{command:g}", hint)
    timeout_s, least_s = info.watchdog_timeout_s, _TIMEOUT_TICKS * rig.tick_s + info.arm_s
    if timeout_s is not None and timeout_s < least_s:
        rule = f"must be >= {least_s:.3g}, {_TIMEOUT_TICKS} ticks of {rig.tick_s:g} s"
        if info.arm_s:
            rule += f" and {info.arm_s:.2g} s to arm it on this line"
        yield broken("device.watchdog.timeout_s", rule, f"{timeout_s:g}")


def channel_problems(channels: Iterable[AuxChannel]) -> Iterator[ConfigProblem]:
    """Yield the auxiliary channels whose names no export or live page could keep apart."""
    seen = set(TAKEN_AUX_NAMES)
    for channel in channels:
        if not _AUX_NAME.fullmatch(channel.name) or channel.name in seen:
            rule = "the name must be a letter and up to 62 letters, digits and '_', and not a name "
            rule += "that exports or the live page use already"
            hint = "end it with the unit, such as coil_c"
            yield broken(f"device.aux.{channel.name}", rule, hint=hint)
        seen.add(channel.name)


def crosstalk_problems(
    options: Mapping[str, Mapping[str, Any]],
) -> Iterator[tuple[str, ConfigProblem]]:
    """Yield the crosstalk of simulated devices that names no other axis, with its axis.

    ``options`` are the device sections by axis.
    """
    for axis, own in options.items():
        others = options.keys() - {axis}
        for name in own.get("crosstalk", {}):
            if name not in others:
                rule, hint = "must name another axis", did_you_mean(name, others)
                yield axis, broken(f"device.crosstalk.{name}", rule, name, hint)


def output_problems(axes: Mapping[str, DeviceInfo]) -> Iterator[tuple[str, ConfigProblem]]:
    """Yield the axes that drive the output of an earlier one, with the broken rule."""
    for (first, one), (second, other) in combinations(axes.items(), 2):
        shared = sorted(set(one.holds) & set(other.holds))
        if shared and one.output == other.output:
            key = "device.output" if other.output else "device"
            rule = f"must not be that of {first} on {shared[0]}"
            yield second, broken(key, rule, hint="each axis needs its own")


def clock_problems(
    axes: Mapping[str, DeviceInfo],
    rate_hz: float,
    block: int,
    joints: Sequence[JointDevice] = (),
) -> Iterator[tuple[str, ConfigProblem]]:
    """Yield the broken rules on the devices of several axes on one clock, each with an axis.

    Simulated devices step on the sample count: they have no clocks, and take no time. Those of a
    joint device have one clock, and take the time of one exchange.
    """
    first, info = next(iter(axes.items()))
    for name, each in axes.items():
        if (each.buffered, each.latency_blocks) != (info.buffered, info.latency_blocks):
            yield name, broken("device", f"must have a FIFO and a latency as that of {first}")
    real = {name: each for name, each in axes.items() if not each.simulated}
    turn_s = exchange_times_s(axes, joints)
    clocks = [names for names in turn_s if real[names[0]].buffered]
    if len(clocks) > 1 and (block > 1 or info.latency_blocks):
        names = names_text([*map(names_text, clocks)])
        rule = f"{names} have clocks of their own, which drift apart"
        hint = "two outputs of one device may stream"
        if info.latency_blocks:
            yield first, broken("device", f"must not stream: {rule}", info.name, hint)
        else:
            yield first, broken("block", f"must be 1: {rule}", str(block), hint)
    for joint in joints:
        yield from ((joint.axes[0], each) for each in _joint_rate_problems(joint, rate_hz, block))
    total_s = sum(turn_s.values())
    if len(turn_s) > 1 and rate_hz * total_s > 1.0:
        each_ms = list(dict.fromkeys(f"{1e3 * duration_s:.3g}" for duration_s in turn_s.values()))
        took = f"{names_text(each_ms)} ms{' each' if len(each_ms) == 1 else ''}"
        hint = f"{names_text([*map(names_text, turn_s)])} are exchanged in turn, {took}"
        rule = f"must be <= {_floor(1.0 / total_s):g}"
        yield first, broken("sample_rate_hz", rule, f"{rate_hz:g}", hint)
    arm_s, tick_s = sum(each.arm_s for each in real.values()), block / rate_hz
    for name, each in real.items():
        timeout_s, least_s = each.watchdog_timeout_s, _TIMEOUT_TICKS * tick_s
        # A shorter one is refused on its own, see watchdog_problems.
        if timeout_s is not None and least_s + each.arm_s <= timeout_s < least_s + arm_s:
            rule = f"must be >= {least_s + arm_s:.3g}, {_TIMEOUT_TICKS} ticks of {tick_s:g} s and "
            rule += f"{arm_s:.2g} s to arm the watchdogs of all axes"
            yield name, broken("device.watchdog.timeout_s", rule, f"{timeout_s:g}")


def exchange_times_s(
    axes: Mapping[str, DeviceInfo], joints: Sequence[JointDevice]
) -> dict[tuple[str, ...], float]:
    """Return the time of each exchange of real devices, in their order, by the axes that it has."""
    found: dict[tuple[str, ...], float] = {}
    of_axis = {name: joint for joint in joints for name in joint.axes}
    for name, info in axes.items():
        if not info.simulated:
            joint = of_axis.get(name)
            names = (name,) if joint is None else tuple(joint.axes)
            found[names] = 1.0 / (info if joint is None else joint).max_rate_hz
    return found


def _joint_rate_problems(joint: JointDevice, rate_hz: float, block: int) -> Iterator[ConfigProblem]:
    """Yield a rate or a block that a joint device does not support."""
    names = names_text(joint.axes)
    if rate_hz > joint.max_rate_hz:
        rule = f"must be <= {joint.max_rate_hz:g}, the highest rate of {names} together"
        yield broken("sample_rate_hz", f"{rule} ({joint.rate_note})", f"{rate_hz:g}")
        return
    try:
        joint.check_rate(rate_hz, block)
    except DeviceError as error:
        rule = f"must allow sample_rate_hz for {names} together, which a larger block does: {error}"
        yield broken("block", rule, str(block))


def link_problems(
    axes: Mapping[str, DeviceInfo], joints: Sequence[JointDevice] = ()
) -> Iterator[tuple[str, ConfigProblem]]:
    """Yield the axes whose device shares its link with that of an earlier one.

    Those of a joint device may, but it has one watchdog.
    """
    together = {frozenset(pair) for joint in joints for pair in combinations(joint.axes, 2)}
    for (first, one), (second, other) in combinations(axes.items(), 2):
        shared = sorted(set(one.holds) & set(other.holds))
        if not shared or one.output == other.output:
            continue
        if frozenset((first, second)) not in together:
            rule = f"must have a link of its own: {shared[0]} is that of {first}"
            hint = f"--set axis={second} runs this one alone"
            yield second, broken("device", rule, other.name, hint)
        elif one.watchdog_timeout_s != other.watchdog_timeout_s:
            rule = f"must be that of {first}: both outputs have the one watchdog of their device"
            key = "device.watchdog.timeout_s" if other.watchdog_timeout_s else "device.watchdog"
            yield second, broken(key, rule)


def skew_notes(
    turn_s: Mapping[tuple[str, ...], float], speeds_um_per_s: Mapping[str, float], least_um: float
) -> Iterator[str]:
    """Yield how far axes leave the path because they are exchanged later, if that is much.

    Args:
        turn_s: Time of each exchange, see :func:`exchange_times_s`.
        speeds_um_per_s: Highest speed of each axis that has a path in um.
        least_um: Largest distance that is not worth a note.
    """
    if not turn_s:
        return
    (first, *_), *others = turn_s
    late_s = 0.0
    for names, before_s in zip(others, turn_s.values(), strict=False):
        late_s += before_s
        for name in names:
            apart_um = late_s * speeds_um_per_s.get(name, 0.0)
            if apart_um > least_um:
                yield (
                    f"{name} is exchanged {1e3 * late_s:.2g} ms after {first}: up to "
                    f"{apart_um:.2g} um apart from the path at this speed. Use one device for both,"
                    " or a lower speed"
                )


def _floor(value: float) -> float:
    """Return a positive number rounded down to four digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.floor(value / step) * step
