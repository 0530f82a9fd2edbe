"""Limits of a characterisation, and the frequency band that follows from the sample rate."""

import math
from dataclasses import dataclass

from hilctl.base.errors import InputError
from hilctl.base.types import F64, CommandUnit
from hilctl.experiment.forecast import CommandFigures
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.template import highest_loop_hz, round_hz

_DECADES = 400.0  # highest over lowest frequency
_SLOWEST_HZ = 0.5  # slower loops take minutes and show creep
_NARROWEST = 4.0
_FEWEST_SAMPLES = 25.0
_OF_RANGE = 0.95
_OF_SLEW = 0.85
_LEAST_PART = 0.25  # least share of the full amplitude in the fastest loops: limits the band
_FEW_SLOW = 0.9  # a slew limit that lowers the band below this share is worth a note
_OF_SLEW_TO_START = 0.13
_NEARLY = 0.99
_OF_HEAT = 0.9


@dataclass(frozen=True, slots=True)
class CharacterisationLimits:
    """Limits of a characterisation, in the command's unit."""

    loaded: LoadedExperiment  # the experiment
    unit: CommandUnit
    low: float  # lowest command
    high: float  # highest command
    rest: float  # safe value, where each run starts and ends
    stroke_um: tuple[float, float]  # allowed range of displacement
    sample_rate_hz: float
    lowest_hz: float  # lowest frequency of loops
    highest_hz: float  # highest frequency of loops
    note: str = ""  # what limits the band, and what to set

    @property
    def centre(self) -> float:
        """Centre of the range and of loops."""
        return 0.5 * (self.low + self.high)

    @property
    def reach(self) -> float:
        """Largest amplitude about the centre."""
        return _OF_RANGE * 0.5 * (self.high - self.low)

    @property
    def middle_hz(self) -> float:
        """Geometric mean of the lowest and highest frequency of loops."""
        return round_hz(math.sqrt(self.lowest_hz * self.highest_hz))

    @property
    def slew_per_s(self) -> float:
        """Largest rate of change of a command, with a margin to the limit."""
        return _OF_SLEW * self.loaded.config.limits.slew_per_s

    def beside_rest(self, amplitude: float) -> float:
        """Return the command nearest to rest with room for an amplitude on both sides."""
        room = min(1.02 * amplitude, 0.5 * (self.high - self.low))
        return min(max(self.rest, self.low + room), self.high - room)

    def by_slew(self, amplitude: float, frequency_hz: float) -> float:
        """Return an amplitude, lowered to the slew limit of a sine at a frequency."""
        return min(amplitude, self.slew_per_s / (2.0 * math.pi * frequency_hz))

    def soft_s(self, amplitude: float, offset: float) -> float:
        """Return the shortest soft start of a sine within the slew limit."""
        travel = amplitude + abs(offset - self.rest)
        return math.pi * travel / (2.0 * _OF_SLEW_TO_START * self.loaded.config.limits.slew_per_s)

    def scale(self, values: F64) -> float:
        """Return the factor, <= 1, that keeps commands within slew, voltage and heat."""
        config = self.loaded.config
        figures = CommandFigures(self.loaded.rig, self.rest, self.rest**2)
        figures.add(values)
        scale = 1.0
        if figures.slew_per_s > 0.0:
            scale = min(scale, _NEARLY * config.limits.slew_per_s / figures.slew_per_s)
        if config.amplifier is not None and figures.voltage_v > 0.0:
            scale = min(scale, _NEARLY * config.amplifier.voltage_max_v / figures.voltage_v)
        budget_a, rms_a = config.limits.rms_current_a, figures.heat.rms_a
        if budget_a is not None and rms_a:
            scale = min(scale, _OF_HEAT * budget_a / rms_a)
        return scale


def limits_of(loaded: LoadedExperiment, highest_hz: float | None = None) -> CharacterisationLimits:
    """Return the limits; ``highest_hz`` follows from sample rate and slew limit if None.

    Loops are made slower before they are made smaller than a quarter of the full amplitude.
    """
    config = loaded.config
    rate_hz = config.sample_rate_hz
    most_hz = rate_hz / _FEWEST_SAMPLES
    if highest_hz is not None and not 0.0 < highest_hz <= most_hz:
        rule = f"must be above 0 and at most {most_hz:g} Hz, {_FEWEST_SAMPLES:g} samples per cycle"
        raise InputError(f"--highest-hz {rule} (got {highest_hz:g})")
    low, high = config.limits.command_range
    slew = config.limits.slew_per_s
    turn = math.pi * _OF_RANGE * (high - low) / _OF_SLEW  # slew of a full loop at 1 Hz
    band_hz = highest_loop_hz(rate_hz)
    top_hz = highest_hz or min(band_hz, round_hz(slew / turn / _LEAST_PART))
    note = ""
    if slew < _FEW_SLOW * turn * (highest_hz or band_hz):
        key = f"limits.slew_{config.limits.unit.lower()}_per_s"
        wanted_hz = highest_hz or band_hz
        note = (
            f"{key} allows loops of full amplitude up to {slew / turn:.2g} Hz: set "
            f"{round_hz(turn * wanted_hz):g} for {wanted_hz:g} Hz"
        )
    return CharacterisationLimits(
        loaded=loaded,
        unit=config.limits.unit,
        low=low,
        high=high,
        rest=config.safe.value,
        stroke_um=config.limits.stroke_um,
        sample_rate_hz=rate_hz,
        lowest_hz=min(max(round_hz(top_hz / _DECADES), _SLOWEST_HZ), top_hz / _NARROWEST),
        highest_hz=top_hz,
        note=note,
    )
