"""The ``safe`` section: the safe value, the ramp to it, and the output that a run begins with."""

import math
from collections.abc import Iterator
from typing import Annotated

from hilctl.base.device import Device, DeviceInfo
from hilctl.base.errors import ConfigProblem, InputError, broken
from hilctl.base.strict import Field, StrictModel

_ROUNDING = 1e-6  # of the device's range: rounding error of a read-back


class Safe(StrictModel):
    """The safe value, and the safe ramp to it that ends every run.

    Attributes:
        value: Command of the safe state, in the device's unit.
        ramp_s: Duration of the safe ramp from the largest allowed command.
        at_start: Output before the run in the device's unit, for a device that cannot report it.
            The run ramps from there to the safe value before its waveform.
    """

    value: float = 0.0
    ramp_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 0.2
    at_start: float | None = None


def safe_problems(safe: Safe, low: float, high: float, unit: str) -> Iterator[ConfigProblem]:
    """Yield that the safe value is outside the limits of the command."""
    if not low <= safe.value <= high:
        rule = f"must lie within the limits, {low:g} to {high:g} {unit}"
        yield broken("safe.value", rule, f"{safe.value:g}")


def at_start_problems(safe: Safe, info: DeviceInfo) -> Iterator[ConfigProblem]:
    """Yield that the output before the run is outside the range of the device."""
    if safe.at_start is not None and not info.command_min <= safe.at_start <= info.command_max:
        span = f"{info.command_min:g} to {info.command_max:g} {info.command_unit}"
        rule = f"must lie within the range of {info.name}, {span}"
        yield broken("safe.at_start", rule, f"{safe.at_start:g}")


def start_warnings(safe: Safe, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if the start of a run will need the output, which is not known."""
    if info.reads_output or safe.at_start is not None:
        return ()
    return (
        f"safe.at_start: a run needs it, because {info.name} cannot read its output, where the "
        f"initial ramp begins. Measure the output before each run, and set it in "
        f"{info.command_unit}.",
    )


def starting_output(device: Device, at_start: float | None) -> float:
    """Return the output of an open device before the run, or raise InputError; nothing moves."""
    info = device.info
    output = device.output()
    if output is None:
        output = at_start
    if output is None:
        raise InputError(
            f"safe.at_start is required: {info.name} cannot read its output, where the initial "
            f"ramp begins. Measure it, and set the key in {info.command_unit}; nothing has moved"
        )
    slack = _ROUNDING * (info.command_max - info.command_min)
    low, high = info.command_min - slack, info.command_max + slack
    if not (math.isfinite(output) and low <= output <= high):
        unit = info.command_unit
        span = f"{info.command_min:g} to {info.command_max:g} {unit}"
        raise InputError(
            f"{info.name}: the output is {output:g} {unit}, outside the device's range {span}, so "
            "no ramp can begin there. Set it to its safe value by hand; nothing has moved"
        )
    return min(info.command_max, max(info.command_min, output))
