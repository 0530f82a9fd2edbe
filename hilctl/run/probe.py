"""Whether an experiment's device answers, and whether what it says can be true; nothing moves."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.device import Device, DeviceInfo, ReadableDevice
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.run.run_folder import held_devices

_ABSURD = 100.0
"""So many times beyond its range a value is no signal: its bytes were put together wrongly."""
_TINY = 1e-18
"""So close to 0, as a share of the range, is no rounding and no signal: likewise."""


@dataclass(frozen=True, slots=True)
class Probed:
    """What a device says.

    Attributes:
        name: Its registry name.
        description: What it is.
        max_rate_hz: Highest sample rate it can keep.
        rate_note: Why that is so.
        safe_note: How late the safe value may get there, where that is worth a word.
        details: What it says of itself.
        displacement_um: What its sensor reads; None where that can't be had without a run.
        output: What it puts out, in ``command_unit``; None where nobody can know.
        command_unit: Unit of its output.
        faults: What can't be true of these, and what it may come from.
    """

    name: str
    description: str
    max_rate_hz: float
    rate_note: str
    safe_note: str
    details: dict[str, str]
    displacement_um: float | None
    output: float | None
    command_unit: str
    faults: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def probe(path: Path, settings: list[str]) -> Probed:
    """Read an experiment's device while nobody else uses it.

    A device is only read, where it can be: no step of its profile is sent, and a watchdog that has
    tripped stays so. Others, and simulated ones, are opened and closed.

    Raises:
        InputError: The experiment can't be used, or a run holds the device.
        DeviceError: The device can't be reached, or is not what it should be.
    """
    loaded = load_experiment(path, settings)
    info = loaded.device.info
    with held_devices(info.holds):
        displacement_um, output = _read(loaded, loaded.device)
    return Probed(
        name=info.name,
        description=info.description,
        max_rate_hz=info.max_rate_hz,
        rate_note=info.rate_note,
        safe_note=info.safe_note,
        details=dict(info.details),
        displacement_um=displacement_um,
        output=output,
        command_unit=info.command_unit,
        faults=judge(info, displacement_um, output),
    )


def _read(loaded: LoadedExperiment, device: Device) -> tuple[float | None, float | None]:
    if isinstance(device, ReadableDevice) and not device.info.simulated:
        return device.look()
    device.open(loaded.config.sample_rate_hz, loaded.config.block)
    try:
        return None, device.output()
    finally:
        device.close()


def judge(info: DeviceInfo, displacement_um: float | None, output: float | None) -> tuple[str, ...]:
    """Return what can't be true of a reading and an output, in sentences; nothing if all can.

    Args:
        info: What the device can read and put out.
        displacement_um: What it reads, um.
        output: What it puts out, in the command's unit.
    """
    found = []
    if displacement_um is not None:
        span = (info.sensor_min_um, info.sensor_max_um)
        found.append(_fault("displacement", displacement_um, span, "um", "the sensor can report"))
    if output is not None:
        span = (info.command_min, info.command_max)
        found.append(_fault("output", output, span, info.command_unit, "the device puts out"))
    return tuple(fault for fault in found if fault)


def _fault(what: str, value: float, span: tuple[float, float], unit: str, whose: str) -> str:
    low, high = span
    size = high - low
    slack = 1e-3 * size  # an end of the range, by a converter's last steps
    tiny = 0.0 < abs(value) < _TINY * size
    if low - slack <= value <= high + slack and not tiny:
        return ""
    absurd = tiny or not math.isfinite(value) or max(low - value, value - high) > _ABSURD * size
    cause = (
        "its bytes are put together wrongly: compare order (ABCD, CDAB, ...), type and address in "
        "the profile with the device's manual"
        if absurd
        else "compare scale, offset and range in the profile, and gain and sensitivity in the "
        "experiment, with what is wired"
    )
    rule = f"{what} must be {low:g} to {high:g} {unit}, which is what {whose}"
    if tiny:
        rule = f"{what} must be 0 or more than rounding leaves of it"
    return f"{rule}, got {value:.4g} {unit} ({cause})"
