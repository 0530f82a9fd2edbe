"""Interlocks: what ends a run by its way out, looked at in every sample that has come back.

All of them are one compiled call a block. Each says at which sample it tripped, by a code for
programs and a reason for people, and marks the samples by its flag.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hilctl.base.arrays import F64, U32
from hilctl.base.device import CommandUnit
from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.kernels import interlock as kernels

TripCode: TypeAlias = Literal[
    "stroke", "sensor_range", "sensor_frozen", "deviation", "thermal", "tracking_error"
]


@dataclass(frozen=True, slots=True)
class Trip:
    """Why a run must end.

    Attributes:
        sample: Sample at which an interlock tripped first.
        code: Which one.
        reason: One line for people.
    """

    sample: int
    code: TripCode
    reason: str


@dataclass(frozen=True, slots=True)
class InterlockLimits:
    """What the interlocks are set to; an infinite limit or time switches one off.

    A condition with a time trips once it has held for longer than that without a break.

    Attributes:
        stroke_um: Lowest and highest displacement that may be measured.
        sensor_um: Ends of what the sensor can report; a reading at an end is no measurement.
        unit: Unit of commands.
        safe: Command at which the output rests before the run.
        frozen_s: Time for which a reading may stay the same once the command has gone
            ``frozen_travel`` away, > 0.
        frozen_um: Largest change of a reading that still counts as the same, >= 0.
        frozen_travel: Travel of the command, in ``unit``, > 0.
        deviation: Largest distance of the measured command from the one put out, in ``unit``; one
            that is not a number is too far.
        deviation_s: Time for which it may be further.
        rms_current_a: Highest running rms of the current, commanded or measured, whichever is
            larger: theta, where d(theta)/dt = (current^2 - theta) / time constant, may not rise
            above its square.
        time_constant_s: That time constant, > 0.
        tracking_um: Largest magnitude of reference - displacement.
        tracking_s: Time for which it may be larger.
    """

    stroke_um: tuple[float, float]
    sensor_um: tuple[float, float] = (-math.inf, math.inf)
    unit: CommandUnit = "A"
    safe: float = 0.0
    frozen_s: float = math.inf
    frozen_um: float = 0.0
    frozen_travel: float = math.inf
    deviation: float = math.inf
    deviation_s: float = 0.0
    rms_current_a: float = math.inf
    time_constant_s: float = 1.0
    tracking_um: float = math.inf
    tracking_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("frozen_s", "frozen_travel", "rms_current_a", "time_constant_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be > 0: {getattr(self, name)}")
        for name in ("frozen_um", "deviation", "deviation_s", "tracking_um", "tracking_s"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"{name} must be >= 0: {getattr(self, name)}")
        for name, (low, high) in (("stroke_um", self.stroke_um), ("sensor_um", self.sensor_um)):
            if not low < high:
                raise InputError(f"{name} must be lowest and highest: {low}, {high}")


class Interlocks:
    """Holds samples against the interlocks, and remembers what they need from block to block.

    Args:
        limits: What they are set to.
        sample_rate_hz: Samples a second.
    """

    def __init__(self, limits: InterlockLimits, sample_rate_hz: float) -> None:
        self.limits = limits
        self._settings = _settings(limits, sample_rate_hz)
        self._memory = np.zeros(kernels.MEMORY)
        self._memory[kernels.READING] = math.nan
        self._memory[kernels.COMMAND] = limits.safe
        self._memory[kernels.HEAT] = limits.safe**2
        self._next_sample = 0

    def check(
        self,
        first_sample: int,
        command: F64,
        reference: F64,
        displacement_um: F64,
        measured: F64,
        flags: U32,
    ) -> Trip | None:
        """Look at the next block; all arrays have its length n, at least 1.

        Args:
            first_sample: Its first sample. Samples left out since the last block count as time
                that has passed with the output held.
            command: float64[n], what was put out, in A or V.
            reference: float64[n], in um; NaN where there is none.
            displacement_um: float64[n].
            measured: float64[n], command as measured; NaN where the device does not measure.
            flags: uint32[n]; the bit of each interlock is added where it trips.

        Returns:
            The first trip in this block, or None.
        """
        if first_sample > self._next_sample:
            self._hold(first_sample - self._next_sample)
        before = self._memory.item(kernels.COMMAND)
        k = kernels.interlock_block(
            self._settings, self._memory, command, reference, displacement_um, measured, flags
        )
        self._next_sample = first_sample + command.size
        if k < 0:
            return None
        if k:
            before = command.item(k - 1)
        sent = (before, command.item(k), measured.item(k))
        seen = (reference.item(k), displacement_um.item(k))
        return self._trip(first_sample + k, flags.item(k), sent, seen)

    def _hold(self, samples: int) -> None:
        """Let samples pass that were never exchanged: the output stays, and so do conditions."""
        memory = self._memory
        rest = memory[kernels.COMMAND] ** 2
        cooling = (1.0 - self._settings[kernels.WARMING]) ** samples
        memory[kernels.HEAT] = rest + (memory[kernels.HEAT] - rest) * cooling
        for run in (kernels.FROZEN_RUN, kernels.DEVIATION_RUN, kernels.TRACKING_RUN):
            if memory[run]:
                memory[run] += samples

    def _trip(
        self,
        sample: int,
        bits: int,
        sent: tuple[float, float, float],
        seen: tuple[float, float],
    ) -> Trip:
        """Say what tripped: where several did, a cause before what follows from it.

        Args:
            sample: Where.
            bits: Its flags.
            sent: Command before it, command, measured command.
            seen: Reference, displacement.
        """
        reference, displacement = seen
        if bits & Flag.SENSOR_INVALID:
            return self._invalid(sample, displacement)
        if bits & Flag.SENSOR_FROZEN:
            return self._frozen(sample, displacement)
        if bits & Flag.DEVIATION:
            return self._deviation(sample, *sent)
        limits = self.limits
        if bits & Flag.THERMAL:
            budget = f"{limits.rms_current_a:g} A rms over {limits.time_constant_s:g} s"
            text = f"thermal budget of the coil, {budget}, was used up at sample {sample}"
            return Trip(sample, "thermal", text)
        error = f"tracking error {reference - displacement:.4g} um at sample {sample}"
        text = f"{error} is beyond {limits.tracking_um:g} um{_since(limits.tracking_s)}"
        return Trip(sample, "tracking_error", text)

    def _invalid(self, sample: int, displacement_um: float) -> Trip:
        reading = f"displacement {displacement_um:.4g} um at sample {sample}"
        low, high = self.limits.sensor_um
        if math.isfinite(displacement_um) and not low < displacement_um < high:
            text = f"{reading} is at the end of what the sensor can report, {low:g} to {high:g} um"
            return Trip(sample, "sensor_range", text)
        low, high = self.limits.stroke_um
        text = f"{reading} is not within the stroke limits {low:g} to {high:g} um"
        return Trip(sample, "stroke", text)

    def _frozen(self, sample: int, displacement_um: float) -> Trip:
        limits = self.limits
        moved = f"the command had moved by {limits.frozen_travel:.3g} {limits.unit}"
        text = (
            f"displacement at sample {sample} is still {displacement_um:.6g} um, "
            f"{limits.frozen_s:g} s after {moved}: the sensor is frozen"
        )
        return Trip(sample, "sensor_frozen", text)

    def _deviation(self, sample: int, before: float, command: float, measured: float) -> Trip:
        limits, unit = self.limits, self.limits.unit
        sent = f"{command:.4g} {unit}"
        if before != command:
            sent = f"{before:.4g} to {sent}"
        text = (
            f"measured {measured:.4g} {unit} at sample {sample}, where {sent} was put out, "
            f"is more than {limits.deviation:g} {unit} away{_since(limits.deviation_s)}"
        )
        return Trip(sample, "deviation", text)


def warming(time_constant_s: float, sample_rate_hz: float) -> float:
    """Return how much of the way to its final heat a coil goes in one sample."""
    return -math.expm1(-1.0 / (time_constant_s * sample_rate_hz))


def _since(time_s: float) -> str:
    return f" for longer than {time_s:g} s" if time_s else ""


def _samples(time_s: float, sample_rate_hz: float) -> float:
    """Return the samples after which a time has passed: whole, but for the infinite."""
    count = time_s * sample_rate_hz
    return float(math.ceil(round(count, 6))) if math.isfinite(count) else math.inf


def _settings(limits: InterlockLimits, sample_rate_hz: float) -> F64:
    watched = math.isfinite(limits.deviation)
    deviation_s = limits.deviation_s if watched else math.inf  # NaN is beyond any distance
    settings = np.empty(kernels.SETTINGS)
    settings[[kernels.STROKE_LOW, kernels.STROKE_HIGH]] = limits.stroke_um
    settings[[kernels.RAIL_LOW, kernels.RAIL_HIGH]] = limits.sensor_um
    settings[kernels.FROZEN_UM] = limits.frozen_um
    settings[kernels.FROZEN_TRAVEL] = limits.frozen_travel
    settings[kernels.FROZEN_SAMPLES] = _samples(limits.frozen_s, sample_rate_hz)
    settings[kernels.DEVIATION] = limits.deviation
    settings[kernels.DEVIATION_SAMPLES] = _samples(deviation_s, sample_rate_hz)
    settings[kernels.WARMING] = warming(limits.time_constant_s, sample_rate_hz)
    settings[kernels.BUDGET] = limits.rms_current_a**2
    settings[kernels.TRACKING_UM] = limits.tracking_um
    settings[kernels.TRACKING_SAMPLES] = _samples(limits.tracking_s, sample_rate_hz)
    return settings
