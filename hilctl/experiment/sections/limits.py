"""The ``limits`` section: settings, and the rules on device, reference and commands."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.strict import BeforeValidator, Field, model_validator
from hilctl.base.types import CommandUnit
from hilctl.experiment.forecast import Forecast
from hilctl.experiment.rig import RunRig
from hilctl.experiment.sections.safe import Safe
from hilctl.loop.interlocks import InterlockRequirement, InterlockSettings
from hilctl.loop.limiter import CommandLimits

_ROUNDING = 1e-9  # of the range of commands
_TRACKING_SHARE = 0.25  # of limits.stroke_um
_TRACKING_S = 1e-3  # less than half a period at 250 Hz, and two samples on a slow wire


def _interval(value: Any) -> Any:
    if type(value) in {int, float}:
        ends = f"[{-abs(value):g}, {abs(value):g}]"
        raise ValueError(f"must be [lowest, highest], such as {ends}: {value:g}")
    numbers = isinstance(value, tuple) and all(isinstance(each, int | float) for each in value)
    if isinstance(value, tuple) and (len(value) != 2 or (numbers and not value[0] < value[1])):
        raise ValueError(f"must be [lowest, highest]: {list(value)}")
    return value


Interval = Annotated[tuple[float, float], BeforeValidator(_interval)]


def _magnitude(value: Any) -> Any:
    if isinstance(value, tuple) and len(value) == 2:
        ends = ", ".join(map(str, value))
        raise ValueError(f"must be one number, for both directions: set limits.drive_a to [{ends}]")
    return value


class Limits(InterlockSettings):
    """Limits of the run, for the limiter (the last block before the device) and the interlocks.

    Attributes:
        peak_current_a: Largest magnitude of the coil current, A, for devices driven in A.
        drive_a: Lowest and highest coil current, A, instead of ``peak_current_a``: for supplies of
            one sign.
        slew_a_per_s: Fastest change of the coil current, A/s.
        drive_v: Lowest and highest drive voltage, V, for devices driven in V.
        slew_v_per_s: Fastest change of the drive voltage, V/s.
        stroke_um: Lowest and highest measured displacement, um; outside, the run ends with its safe
            ramp.
        aux: Highest value of an auxiliary channel of the device, or its lowest and highest value,
            by name and in its unit. A missing value counts as outside after ``sensor_invalid_s``.
    """

    peak_current_a: Annotated[float, Field(gt=0.0), BeforeValidator(_magnitude)] | None = None
    drive_a: Interval | None = None
    slew_a_per_s: Annotated[float, Field(gt=0.0)] | None = None
    drive_v: Interval | None = None
    slew_v_per_s: Annotated[float, Field(gt=0.0)] | None = None
    stroke_um: Interval
    aux: dict[str, float | Interval] | None = None

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        names = ("peak_current_a", "drive_a", "slew_a_per_s", "drive_v", "slew_v_per_s")
        given = {name for name in names if getattr(self, name) is not None}
        complete = (
            {"peak_current_a", "slew_a_per_s"},
            {"drive_a", "slew_a_per_s"},
            {"drive_v", "slew_v_per_s"},
        )
        if given not in complete:
            raise ValueError(
                "must have peak_current_a (or drive_a) and slew_a_per_s for a device driven in A, "
                "or drive_v and slew_v_per_s for a device driven in V"
            )
        return self

    @property
    def range_key(self) -> str:
        """Key of the range of the command."""
        keys = ("drive_v", "drive_a", "peak_current_a")
        return next(key for key in keys if getattr(self, key) is not None)

    @property
    def unit(self) -> CommandUnit:
        """Unit of the limited commands."""
        return "V" if self.drive_v is not None else "A"

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command, in :attr:`unit`."""
        if (given := self.drive_v or self.drive_a) is not None:
            return given
        peak = self.peak_current_a or 0.0
        return -peak, peak

    @property
    def slew_per_s(self) -> float:
        """Fastest change of the command, in :attr:`unit` per second."""
        return self.slew_v_per_s or self.slew_a_per_s or 0.0

    def of_command(self, safe: Safe) -> CommandLimits:
        """Return the settings of the limiter, in :attr:`unit`."""
        low, high = self.command_range
        furthest = max(high - safe.value, safe.value - low)
        return CommandLimits(
            low=low,
            high=high,
            slew_per_s=self.slew_per_s,
            safe=safe.value,
            ramp_per_s=min(self.slew_per_s, furthest / safe.ramp_s),
        )

    def tracking(self, rate_hz: float) -> InterlockSettings:
        """Return the interlocks of a compensated run, with the default of its tracking error."""
        if "tracking_error_um" in self.model_fields_set:
            return self
        low_um, high_um = self.stroke_um
        most_um, time_s = _TRACKING_SHARE * (high_um - low_um), max(_TRACKING_S, 1.0 / rate_hz)
        return self.model_copy(update={"tracking_error_um": most_um, "tracking_s": time_s})


def range_problems(
    limits: Limits, info: DeviceInfo, device: Mapping[str, Any]
) -> Iterator[ConfigProblem]:
    """Yield the limits beyond the range of device and sensor.

    ``device`` is the device's section: its scales determine both ranges.
    """
    low, high = limits.command_range
    unit = info.command_unit
    if limits.unit != unit:
        yield broken("limits", f"must be in {unit}, the unit of {info.name}", limits.unit)
    elif low < info.command_min or high > info.command_max:
        span = f"{info.command_min:g} to {info.command_max:g} {unit}"
        rule = f"must lie within the range of {info.name}, {span}"
        hint = _or_scale(_narrower(limits, info), device, "amplifier")
        yield broken(f"limits.{limits.range_key}", rule, f"{low:g} to {high:g}", hint)
    low_um, high_um = limits.stroke_um
    if low_um < info.sensor_min_um or high_um > info.sensor_max_um:
        span = f"{info.sensor_min_um:g} to {info.sensor_max_um:g} µm"
        rule = f"must lie within the range of the sensor, {span}"
        inside = max(low_um, info.sensor_min_um), min(high_um, info.sensor_max_um)
        hint = f"set limits.stroke_um to {list(inside)!r}" if inside[0] < inside[1] else ""
        hint = _or_scale(hint, device, "sensor")
        yield broken("limits.stroke_um", rule, f"{low_um:g} to {high_um:g}", hint)


def _or_scale(narrower: str, device: Mapping[str, Any], part: str) -> str:
    """Return the hint that a scale of the device's section may be wrong, or narrower limits."""
    scales = device.get(part)
    if not isinstance(scales, Mapping):
        return narrower
    named = ", ".join(f"{key} {value}" for key, value in scales.items() if value is not None)
    scale = f"correct device.{part} ({named}) if it is not that of your {part}"
    return f"{scale}, or {narrower}" if narrower else scale


def _narrower(limits: Limits, info: DeviceInfo) -> str:
    """Return the largest limits within the range of a device; empty if there are none."""
    low, high = limits.command_range
    low, high = max(low, info.command_min), min(high, info.command_max)
    if not low < high:
        return ""
    if limits.peak_current_a is None:
        return f"set limits.{limits.range_key} to [{low!r}, {high!r}]"
    if low < 0.0 < high:
        return f"set limits.peak_current_a to {min(-low, high)!r}"
    return f"set limits.drive_a to [{low!r}, {high!r}] instead of limits.peak_current_a"


def interlock_problems(
    limits: Limits, info: DeviceInfo, *, compensated: bool
) -> Iterator[ConfigProblem]:
    """Yield the interlocks whose requirements are not met."""
    names = [each.name for each in info.aux]
    known = f"must be an auxiliary channel of {info.name} ({', '.join(names) or 'it has none'})"
    for name in limits.aux or {}:
        if name not in names:
            yield broken(f"limits.aux.{name}", known)
    for key, field in InterlockSettings.model_fields.items():
        if getattr(limits, key) is not None:
            for needs in field.metadata:
                if isinstance(needs, InterlockRequirement):
                    for rule in _unmet(needs, limits, info, compensated=compensated):
                        yield broken(f"limits.{key}", rule)


def _unmet(
    needs: InterlockRequirement, limits: Limits, info: DeviceInfo, *, compensated: bool
) -> Iterator[str]:
    if needs.unit is not None and needs.unit != limits.unit:
        yield f"is for a device driven in {needs.unit}, but the limits are in {limits.unit}"
    if needs.key is not None and getattr(limits, needs.key) is None:
        unit = f"_{limits.unit.lower()}" if needs.key == "measured_deviation" else ""
        yield f"needs limits.{needs.key}{unit}"
    if needs.reference_um and not compensated:
        yield "needs a compensator: without one there is no reference in um to track"
    if needs.measured and not info.measures_command:
        yield f"needs a device that measures its command: {info.name} does not"


@dataclass(frozen=True, slots=True)
class Excess:
    """A limit that a run exceeds.

    Attributes:
        of: What exceeds it.
        problem: The broken rule, without a cure.
        amount: Excess, in ``unit``.
        allowed: Lowest and highest permitted value.
        at_s: Time from the start of the conditioning; NaN for the whole run.
    """

    of: Literal["reference", "command", "slew", "voltage", "heat"]
    problem: ConfigProblem
    amount: float
    unit: str
    allowed: tuple[float, float]
    at_s: float = math.nan


def reference_excess(
    limits: Limits, span: tuple[float, float], identified: tuple[float, float] | None = None
) -> Iterator[Excess]:
    """Yield the ranges that a reference in um with this span leaves.

    ``identified`` is the range that the model was identified on; None if it is unknown.
    """
    ranges = {"limits.stroke_um": limits.stroke_um}
    if identified is not None:
        ranges["the range that compensator.model was identified on"] = identified
    for name, (lowest, highest) in ranges.items():
        excess_um = max(lowest - span[0], span[1] - highest)
        if excess_um > 0.0:
            rule = f"reference must stay within {name}, {lowest:g} to {highest:g} µm"
            problem = broken("waveform", rule, f"{span[0]:.6g} to {span[1]:.6g} µm")
            yield Excess("reference", problem, excess_um, "µm", (lowest, highest))


def command_excess(limits: Limits, rig: RunRig, forecast: Forecast) -> Iterator[Excess]:
    """Yield the limits that the commands of a run exceed; they must be finite.

    An excess below a step of the output is none: the limiter takes it away.
    """
    unit, (low, high), slew_per_s = limits.unit, limits.command_range, limits.slew_per_s
    if (excess := _beyond(limits, forecast)) > rig.info.command_step:
        below = low - forecast.command_min == excess
        rule = f"the run must stay within {low:g} to {high:g} {unit}"
        span = f"{forecast.command_min:.6g} to {forecast.command_max:.6g} {unit}"
        problem = broken(f"limits.{limits.range_key}", rule, span)
        at_s = forecast.lowest_at_s if below else forecast.highest_at_s
        yield Excess("command", problem, excess, unit, (low, high), at_s)
    if forecast.slew_per_s > slew_per_s:
        rule = f"the run must change no faster than {slew_per_s:g} {unit}/s"
        key = f"limits.slew_{unit.lower()}_per_s"
        problem = broken(key, rule, f"{forecast.slew_per_s:.6g}")
        excess, allowed = forecast.slew_per_s - slew_per_s, (-slew_per_s, slew_per_s)
        yield Excess("slew", problem, excess, f"{unit}/s", allowed, forecast.fastest_at_s)
    if rig.amplifier is not None and forecast.voltage_v is not None:
        most_v = rig.amplifier.voltage_max_v
        if (excess := forecast.voltage_v - most_v) > 0.0:
            rule = f"the voltage of the run must be <= {most_v:g} V"
            problem = broken("amplifier.voltage_max_v", rule, f"{forecast.voltage_v:.4g} V")
            allowed = -most_v, most_v
            yield Excess("voltage", problem, excess, "V", allowed, forecast.voltage_at_s)
    used_s, rms_a, highest_a = forecast.budget_used_s, limits.rms_current_a, forecast.heating_rms_a
    if used_s is not None and rms_a is not None and highest_a is not None:
        time_s = limits.thermal_time_constant_s
        rule = f"the coil must stay within {rms_a:g} A rms over {time_s:g} s"
        problem = broken("limits.rms_current_a", rule, f"{highest_a:.4g} A")
        yield Excess("heat", problem, highest_a - rms_a, "A", (0.0, rms_a), used_s)


def _beyond(limits: Limits, forecast: Forecast) -> float:
    """Return by how much commands exceed their range; 0 for rounding errors."""
    low, high = limits.command_range
    excess = max(low - forecast.command_min, forecast.command_max - high)
    return excess if excess > _ROUNDING * (high - low) else 0.0


def clamp_warnings(limits: Limits, rig: RunRig, forecast: Forecast) -> tuple[str, ...]:
    """Return a warning if commands exceed their range by less than a step of the output."""
    if not (excess := _beyond(limits, forecast)):
        return ()
    return (
        f"limits.{limits.range_key}: commands exceed it by {excess:.2g} {limits.unit}, less than a "
        f"step of the output, {rig.info.command_step:.2g} {limits.unit}: the limiter clamps them",
    )
