"""Interlocks: conditions that end a run by its safe ramp, checked in every answered sample.

One compiled call per block checks all of them. A trip has a sample, a code and a reason, and the
interlock's flag marks the samples.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeAlias

import numpy as np

from hilctl.base.device import AuxChannel
from hilctl.base.errors import InputError
from hilctl.base.samples import BlockHeader, Flag
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import F64, U32, CommandUnit
from hilctl.kernels import interlock as kernels
from hilctl.kernels.interlock import InterlockFlag
from hilctl.kernels.jit import compiled
from hilctl.loop.block import Block

TripCode: TypeAlias = Literal[
    "stroke",
    "sensor_invalid",
    "sensor_range",
    "sensor_frozen",
    "deviation",
    "thermal",
    "tracking_error",
    "aux",
    "apart",
]

_FIRST_SAMPLE = int(BlockHeader.FIRST_SAMPLE)
_TRIPPED = sum(InterlockFlag)
_AUX = int(InterlockFlag.AUX)


@dataclass(frozen=True, slots=True)
class Trip:
    """Why a run must end: first sample, code of the interlock, one line of text."""

    sample: int
    code: TripCode
    reason: str


@dataclass(frozen=True, slots=True)
class InterlockRequirement:
    """Requirements of a key.

    Attributes:
        unit: Command unit of the device; None for either.
        key: Another key; ``measured_deviation`` means the key for the device's unit.
        reference_um: Whether a compensator, and thus a reference in um, is required.
        measured: Whether the device must measure its command.
    """

    unit: CommandUnit | None = None
    key: str | None = None
    reference_um: bool = False
    measured: bool = False


_Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
_NotNegative: TypeAlias = Annotated[float, Field(ge=0.0)]


class InterlockSettings(StrictModel):
    """Settings of the interlocks: keys of an experiment's ``limits``; None disables an interlock.

    A condition with a time trips if it is true without interruption for longer than that time. A
    missing reading does not interrupt a condition on readings.
    """

    rms_current_a: Annotated[
        _Positive | None, InterlockRequirement("A", "thermal_time_constant_s")
    ] = Field(
        default=None,
        description="largest running rms of the coil current, commanded or measured, A; includes"
        " the coil's heat from the last run of the device",
    )
    thermal_time_constant_s: Annotated[
        _Positive | None, InterlockRequirement("A", "rms_current_a")
    ] = Field(default=None, description="thermal time constant of the coil, s")
    tracking_error_um: Annotated[_Positive | None, InterlockRequirement(reference_um=True)] = Field(
        default=None,
        description="largest |reference - displacement| of a compensated run, um; default: a"
        " quarter of limits.stroke_um for 1 ms; null disables it",
    )
    tracking_s: Annotated[_NotNegative | None, InterlockRequirement(key="tracking_error_um")] = (
        Field(default=None, description="time for which the error may be larger, s; default: 0")
    )
    sensor_invalid_s: _Positive | None = Field(
        default=None,
        description="time for which the device may mark its readings as invalid, s; default: 0, the"
        " first such reading ends the run",
    )
    frozen_s: _Positive | None = Field(
        default=None,
        description="time for which the displacement may stay constant after the command has moved"
        " by 2 % of its range, s",
    )
    frozen_um: Annotated[_NotNegative | None, InterlockRequirement(key="frozen_s")] = Field(
        default=None,
        description="largest change of the displacement that counts as constant, um; default: 0",
    )
    measured_deviation_a: Annotated[_Positive | None, InterlockRequirement("A", measured=True)] = (
        Field(
            default=None,
            description="largest deviation of the measured current from the command, A",
        )
    )
    measured_deviation_v: Annotated[_Positive | None, InterlockRequirement("V", measured=True)] = (
        Field(
            default=None, description="largest deviation of the measured drive from the command, V"
        )
    )
    deviation_s: Annotated[_NotNegative | None, InterlockRequirement(key="measured_deviation")] = (
        Field(default=None, description="time for which the deviation may be larger, s; default: 0")
    )

    @property
    def measured_deviation(self) -> float | None:
        """Largest difference of measured command and command, in the command's unit."""
        return self.measured_deviation_a or self.measured_deviation_v


class ApartSettings(StrictModel):
    """Interlock on the difference of the displacements of two axes, for a run with ``axes``.

    Attributes:
        axes: Names of the two axes.
        um: Largest difference of their displacements, um.
        for_s: Time for which the difference may be larger, s.
    """

    axes: tuple[str, str]
    um: _Positive
    for_s: _NotNegative = 0.0


@dataclass(frozen=True, slots=True)
class AuxLimit:
    """Lowest and highest permitted value of an auxiliary channel; infinite without a limit."""

    channel: AuxChannel
    low: float = -math.inf
    high: float = math.inf

    @property
    def is_limited(self) -> bool:
        """Whether there is a limit."""
        return math.isfinite(self.low) or math.isfinite(self.high)

    def __str__(self) -> str:
        unit = f" {self.channel.unit}".rstrip()
        if not self.is_limited:
            return f"no limit{unit and ','}{unit}"
        least = f"{self.low:g} to" if math.isfinite(self.low) else "at most"
        return f"{least} {self.high:g}{unit}"


@dataclass(frozen=True, slots=True)
class InterlockContext:
    """Properties of the rig that interlocks need.

    Attributes:
        stroke_um: Lowest and highest permitted displacement.
        sensor_um: Range of the sensor; a reading at its end is invalid.
        safe: Safe value, the command before the run.
        frozen_travel: Travel of the command after which a reading must change, in ``unit``.
        heat_a2: Heat of the coil before the run: running mean square of the current in A^2, at
            least that of the safe value.
        aux: The auxiliary channels of the device with their limits.
    """

    stroke_um: tuple[float, float]
    sensor_um: tuple[float, float] = (-math.inf, math.inf)
    unit: CommandUnit = "A"
    safe: float = 0.0
    frozen_travel: float = math.inf
    heat_a2: float = 0.0
    aux: tuple[AuxLimit, ...] = ()

    def __post_init__(self) -> None:
        if not self.frozen_travel > 0.0:
            raise InputError(f"frozen_travel must be > 0: {self.frozen_travel}")
        for name, (low, high) in (("stroke_um", self.stroke_um), ("sensor_um", self.sensor_um)):
            if not low < high:
                raise InputError(f"{name} must be lowest and highest: {low}, {high}")


class Interlocks:
    """Check blocks of samples against the interlocks."""

    def __init__(
        self, context: InterlockContext, settings: InterlockSettings, sample_rate_hz: float
    ) -> None:
        self.context = context
        self.settings = settings
        self._numbers = _numbers(context, settings, sample_rate_hz)
        self._memory = np.zeros(kernels.MEMORY)
        self._memory[kernels.READING] = math.nan
        self._memory[kernels.COMMAND] = context.safe
        self._memory[kernels.HEAT] = max(context.heat_a2, context.safe**2)
        self._next_sample = 0
        self._aux = [(k, each) for k, each in enumerate(context.aux) if each.is_limited]
        self._aux_missing = [0] * len(context.aux)  # samples
        self._interlock_block = compiled(kernels.interlock_block)

    def begin_at(self, command: float) -> None:
        """Set the present output; the coil has at least the heat that this command causes."""
        memory = self._memory
        memory[kernels.COMMAND] = command
        memory[kernels.HEAT] = max(memory[kernels.HEAT], command**2)

    def zero(self, offset_um: float) -> None:
        """Shift the sensor's range, because an offset is subtracted from its readings."""
        low, high = self.context.sensor_um
        self.context = replace(self.context, sensor_um=(low - offset_um, high - offset_um))
        self._numbers[[kernels.RAIL_LOW, kernels.RAIL_HIGH]] = self.context.sensor_um

    def judge(self, block: Block) -> Trip | None:
        """Check the next block; return its first trip, or None."""
        sent = block.command, block.reference
        came = block.displacement_um, block.measured
        trip = self.check(block.head[_FIRST_SAMPLE], *sent, *came, block.flags)
        return self._check_aux(block) if trip is None and self._aux else trip

    def check(
        self,
        first_sample: int,
        command: F64,
        reference: F64,
        displacement_um: F64,
        measured: F64,
        flags: U32,
    ) -> Trip | None:
        """Check the next block, of n samples; return its first trip, or None.

        Samples skipped before it count as time with a constant output. Signals are float64[n]: the
        command and the measured one in A or V, the others in um; NaN is a missing reference or
        measured command. The bits of tripped interlocks are added to ``flags``, uint32[n].
        """
        if first_sample > self._next_sample:
            self._hold(first_sample - self._next_sample)
        self._next_sample = first_sample + command.size
        before = self._memory.item(kernels.COMMAND)
        k = self._interlock_block(
            self._numbers, self._memory, command, reference, displacement_um, measured, flags
        )
        if k < 0:
            return None
        if k:
            before = command.item(k - 1)
        sent = (before, command.item(k), measured.item(k))
        seen = (reference.item(k), displacement_um.item(k))
        return self._trip(first_sample + k, flags.item(k), sent, seen)

    def _check_aux(self, block: Block) -> Trip | None:
        """Check the auxiliary channels; a value may be missing as long as an invalid one."""
        for k, limit in self._aux:
            value = block.aux.item(k)
            if limit.low <= value <= limit.high:
                self._aux_missing[k] = 0
                continue
            if math.isnan(value):
                self._aux_missing[k] += block.skipped + block.flags.size
                if self._aux_missing[k] <= self._numbers[kernels.MISSING_SAMPLES]:
                    continue
            block.flags |= _AUX
            return self._aux_trip(block.head[_FIRST_SAMPLE], limit, value)
        return None

    def _aux_trip(self, sample: int, limit: AuxLimit, value: float) -> Trip:
        name = limit.channel.name
        text = f"{name} {value:.6g} {limit.channel.unit} at sample {sample} must be {limit}"
        if math.isnan(value):
            since = for_longer_than(self.settings.sensor_invalid_s)
            text = f"{name} at sample {sample} is no valid reading{since}"
        return Trip(sample, "aux", text)

    def _hold(self, samples: int) -> None:
        """Account for skipped samples, during which the output and all conditions stay constant."""
        memory = self._memory
        rest = memory[kernels.COMMAND] ** 2
        cooling = (1.0 - self._numbers[kernels.WARMING]) ** samples
        memory[kernels.HEAT] = rest + (memory[kernels.HEAT] - rest) * cooling
        runs = kernels.FROZEN_RUN, kernels.DEVIATION_RUN, kernels.TRACKING_RUN, kernels.MISSING_RUN
        for run in runs:
            if memory[run]:
                memory[run] += samples

    def _trip(
        self, sample: int, bits: int, sent: tuple[float, float, float], seen: tuple[float, float]
    ) -> Trip:
        """Return the trip; if there are several, a cause takes precedence over its consequence.

        ``sent``: previous command, command, measured command; ``seen``: reference, displacement.
        """
        reference, displacement = seen
        settings = self.settings
        # A missing reading that is permitted for a time is not the reason of another trip.
        permitted = settings.sensor_invalid_s and math.isnan(displacement) and bits & _TRIPPED
        if bits & Flag.SENSOR_INVALID and not permitted:
            return self._invalid(sample, displacement)
        if bits & InterlockFlag.SENSOR_FROZEN:
            return self._frozen(sample, displacement)
        if bits & InterlockFlag.DEVIATION:
            return self._deviation(sample, *sent)
        if bits & InterlockFlag.THERMAL:
            rms_a, time_s = settings.rms_current_a, settings.thermal_time_constant_s
            budget = f"{rms_a:g} A rms over {time_s:g} s"
            text = f"thermal budget of the coil, {budget}, was used up at sample {sample}"
            return Trip(sample, "thermal", text)
        error = f"tracking error {reference - displacement:.4g} µm at sample {sample}"
        beyond = f"beyond {settings.tracking_error_um:g} µm{for_longer_than(settings.tracking_s)}"
        return Trip(sample, "tracking_error", f"{error} is {beyond}")

    def _invalid(self, sample: int, displacement_um: float) -> Trip:
        if math.isnan(displacement_um):
            since = for_longer_than(self.settings.sensor_invalid_s)
            text = f"displacement at sample {sample} is no valid reading{since}"
            return Trip(sample, "sensor_invalid", text)
        reading = f"displacement {displacement_um:.4g} µm at sample {sample}"
        low, high = self.context.sensor_um
        if math.isfinite(displacement_um) and not low < displacement_um < high:
            text = f"{reading} is at an end of the sensor's range, {low:g} to {high:g} µm"
            return Trip(sample, "sensor_range", text)
        low, high = self.context.stroke_um
        text = f"{reading} is outside the stroke limits {low:g} to {high:g} µm"
        return Trip(sample, "stroke", text)

    def _frozen(self, sample: int, displacement_um: float) -> Trip:
        context = self.context
        moved = f"the command had moved by {context.frozen_travel:.3g} {context.unit}"
        text = (
            f"displacement at sample {sample} is still {displacement_um:.6g} µm, "
            f"{self.settings.frozen_s:g} s after {moved}: the sensor is frozen"
        )
        return Trip(sample, "sensor_frozen", text)

    def _deviation(self, sample: int, before: float, command: float, measured: float) -> Trip:
        settings, unit = self.settings, self.context.unit
        sent = f"{command:.4g} {unit}"
        if before != command:
            sent = f"{before:.4g} to {sent}"
        away = f"more than {settings.measured_deviation:g} {unit} away"
        text = (
            f"measured {measured:.4g} {unit} at sample {sample}, with a command of {sent}, "
            f"is {away}{for_longer_than(settings.deviation_s)}"
        )
        return Trip(sample, "deviation", text)


class ApartInterlock:
    """Compare the displacements of two axes, block by block."""

    def __init__(self, settings: ApartSettings, sample_rate_hz: float) -> None:
        self._settings = settings
        self._limits = settings.um, in_samples(settings.for_s, sample_rate_hz)
        self._run = np.zeros(1)
        self._apart_block = compiled(kernels.apart_block)

    def judge(self, first: Block, second: Block) -> Trip | None:
        """Check the next block of both axes, of the same samples; return its first trip, or None.

        Samples skipped before it count as time with constant displacements.
        """
        if self._run[0]:
            self._run[0] += first.skipped
        both_um = first.displacement_um, second.displacement_um
        k = self._apart_block(*self._limits, self._run, *both_um, first.flags, second.flags)
        if k < 0:
            return None
        sample, settings = first.head[_FIRST_SAMPLE] + k, self._settings
        apart_um = both_um[1].item(k) - both_um[0].item(k)
        away = f"{apart_um:+.4g} µm from {settings.axes[0]} at sample {sample}"
        beyond = f"beyond {settings.um:g} µm{for_longer_than(settings.for_s)}"
        return Trip(sample, "apart", f"displacement {away} is {beyond}")


def warming(time_constant_s: float, sample_rate_hz: float) -> float:
    """Return the fraction of the remaining heating of a coil that one sample adds."""
    return -math.expm1(-1.0 / (time_constant_s * sample_rate_hz))


def for_longer_than(time_s: float | None) -> str:
    """Return a text on the time that an interlock allows; empty if it allows none."""
    return f" for longer than {time_s:g} s" if time_s else ""


def in_samples(time_s: float, rate_hz: float) -> float:
    """Return a time in samples, rounded up; infinite if it is infinite."""
    count = time_s * rate_hz
    return float(math.ceil(round(count, 6))) if math.isfinite(count) else math.inf


def _or_inf(value: float | None) -> float:
    return math.inf if value is None else value


def _numbers(context: InterlockContext, given: InterlockSettings, rate_hz: float) -> F64:
    """Return the settings of the kernel: float64[kernels.SETTINGS]."""
    deviation = _or_inf(given.measured_deviation)
    # A NaN exceeds any deviation, even an infinite one: the infinite time disables the interlock.
    deviation_s = given.deviation_s or 0.0 if math.isfinite(deviation) else math.inf
    numbers = np.empty(kernels.SETTINGS)
    numbers[[kernels.STROKE_LOW, kernels.STROKE_HIGH]] = context.stroke_um
    numbers[[kernels.RAIL_LOW, kernels.RAIL_HIGH]] = context.sensor_um
    numbers[kernels.FROZEN_UM] = given.frozen_um or 0.0
    numbers[kernels.FROZEN_TRAVEL] = context.frozen_travel
    numbers[kernels.FROZEN_SAMPLES] = in_samples(_or_inf(given.frozen_s), rate_hz)
    numbers[kernels.DEVIATION] = deviation
    numbers[kernels.DEVIATION_SAMPLES] = in_samples(deviation_s, rate_hz)
    numbers[kernels.WARMING] = warming(given.thermal_time_constant_s or 1.0, rate_hz)
    numbers[kernels.BUDGET] = _or_inf(given.rms_current_a) ** 2
    numbers[kernels.TRACKING_UM] = _or_inf(given.tracking_error_um)
    numbers[kernels.TRACKING_SAMPLES] = in_samples(given.tracking_s or 0.0, rate_hz)
    numbers[kernels.MISSING_SAMPLES] = in_samples(given.sensor_invalid_s or 0.0, rate_hz)
    return numbers
