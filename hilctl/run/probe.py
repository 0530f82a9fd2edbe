"""Probe: read an experiment's devices and check their values for plausibility; nothing moves."""

import math
from dataclasses import dataclass
from pathlib import Path

from hilctl.base.device import Device, DeviceInfo, DeviceReadings, ReadableDevice
from hilctl.base.errors import DeviceError
from hilctl.experiment.load import LoadedExperiment, load_axes
from hilctl.run.run_folder import DeviceLocks

_ABSURD = 100.0  # A value this many ranges outside is not a signal: its bytes are decoded wrongly
_TINY = 1e-18  # A value this close to 0, relative to the range, is decoded wrongly as well


@dataclass(frozen=True, slots=True)
class Probed:
    """Values read from a device."""

    name: str
    description: str
    max_rate_hz: float
    rate_note: str
    safe_note: str
    details: dict[str, str]
    displacement_um: float | None  # None if the sensor is not available without a run
    output: float | None  # output in ``command_unit``; None if unknown
    measured: float | None  # output as measured by the device; None if it is not
    tripped: bool  # whether the device's watchdog has tripped, if that can be read
    command_unit: str
    faults: tuple[str, ...]  # implausible values, each with a possible cause


def probe(path: Path, settings: list[str]) -> dict[str, Probed]:
    """Read the device of each axis under its lock, or open and close it.

    Returns:
        The values of each axis by name; those of an experiment without axes under "".

    Raises:
        InputError: The file is not valid, or a run holds a device.
        DeviceError: Devices did not answer; the error names their axes.
    """
    # Reading sends no set-up steps, and a tripped watchdog stays tripped.
    axes = load_axes(path, settings)
    found, errors = dict[str, Probed](), list[str]()
    with DeviceLocks([name for each in axes for name in each.device.info.holds]) as locks:
        locks.acquire()
        for loaded in axes:
            try:
                found[loaded.axis] = _probed(loaded)
            except DeviceError as error:
                if not loaded.axis:
                    raise
                errors.append(f"{loaded.axis}: {error}")
    if errors:
        raise DeviceError("; ".join(errors))
    return found


def _probed(loaded: LoadedExperiment) -> Probed:
    """Read the device of an axis."""
    info = loaded.device.info
    displacement_um, output, measured, tripped = _read(loaded, loaded.device)
    return Probed(
        name=info.name,
        description=info.description,
        max_rate_hz=info.max_rate_hz,
        rate_note=info.rate_note,
        safe_note=info.safe_note,
        details=dict(loaded.device.info.details),
        displacement_um=displacement_um,
        output=output,
        measured=None if math.isnan(measured) else measured,
        tripped=tripped,
        command_unit=info.command_unit,
        faults=judge(info, displacement_um, output),
    )


def _read(
    loaded: LoadedExperiment, device: Device
) -> DeviceReadings | tuple[None, float | None, float, bool]:
    if isinstance(device, ReadableDevice) and not device.info.simulated:
        return DeviceReadings(*device.look())
    device.open(loaded.config.sample_rate_hz, loaded.config.block)
    try:
        return None, device.output(), math.nan, False
    finally:
        device.close()


def judge(info: DeviceInfo, displacement_um: float | None, output: float | None) -> tuple[str, ...]:
    """Return descriptions of implausible values."""
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
    slack = 1e-3 * size  # resolution of a converter
    tiny = 0.0 < abs(value) < _TINY * size
    if low - slack <= value <= high + slack and not tiny:
        return ""
    absurd = tiny or not math.isfinite(value) or max(low - value, value - high) > _ABSURD * size
    cause = (
        "its bytes are decoded wrongly: compare order (ABCD, CDAB, ...), type and address in "
        "the profile with the device's manual"
        if absurd
        else "compare scale, offset and range in the profile, and gain and sensitivity in the "
        "experiment, with the wiring"
    )
    rule = f"{what} must be {low:g} to {high:g} {unit}, which is what {whose}"
    if tiny:
        rule = f"{what} must be 0 or more than rounding leaves of it"
    return f"{rule}, got {value:.4g} {unit} ({cause})"
