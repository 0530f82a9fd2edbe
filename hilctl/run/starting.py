"""Where the output is before a run: asked of the open device, or vouched for in the experiment."""

import math

from hilctl.base.device import Device
from hilctl.base.errors import InputError

_ROUNDING = 1e-6  # of the device's range: what reading an end of it back may be off by


def starting_output(device: Device, at_start: float | None) -> float:
    """Return the command at which the output of an open device stands; nothing moves.

    Args:
        device: Open; what it says goes before ``at_start``.
        at_start: ``safe.at_start`` of the experiment, for devices that can't know.

    Raises:
        InputError: Neither says it, or the output is where no command can have put it.
        DeviceError: The device did not answer.
    """
    info = device.info
    output = device.output()
    if output is None:
        output = at_start
    if output is None:
        raise InputError(
            f"safe.at_start: is required: {info.name} can't tell what it puts out, and a run ramps "
            f"from there to safe.value: measure it, and give it in {info.command_unit}; "
            "nothing has moved"
        )
    slack = _ROUNDING * (info.command_max - info.command_min)
    low, high = info.command_min - slack, info.command_max + slack
    if not (math.isfinite(output) and low <= output <= high):
        unit = info.command_unit
        span = f"{info.command_min:g} to {info.command_max:g} {unit}"
        raise InputError(
            f"{info.name}: puts out {output:g} {unit}, which is not within what it takes, {span}: "
            "no ramp can begin there: bring it to its safe value by hand; nothing has moved"
        )
    return min(info.command_max, max(info.command_min, output))
