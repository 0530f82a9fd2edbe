"""Forecast of a run: all of its commands by its own compensator, reduced to numbers.

Long references are periodic as a rule, so the simulation skips cycles once two in a row agree: so
closely that the last cycle would still agree if each differed from the one before by as much.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.types import CHUNK, F64
from hilctl.experiment.coil_heat import CoilHeat, RunHeat
from hilctl.experiment.rig import RunRig
from hilctl.experiment.sections.compensator import CompensatorStart
from hilctl.kernels.dynamics import lag_block
from hilctl.loop.compensator import Compensator
from hilctl.loop.tuning import LinearBypass
from hilctl.models.base import HysteresisModel
from hilctl.waveforms.build import Reference, RepeatedPart
from hilctl.waveforms.shapes import LONG

_MOST_PERIODS = 1024
_LEAST_CYCLE = 65_536
"""Least samples of a compared cycle; comparing shorter ones one by one would be slow."""
_WHOLE = 1e-3  # largest deviation of the skipped part from a whole number of samples, in samples
_SAME = 1e-3  # largest deviation of the last cycle from the computed one, relative to its span


@dataclass(frozen=True, slots=True)
class Forecast:
    """The commands of a run in numbers."""

    samples: int
    duration_s: float
    before_s: float  # time of the conditioning before the waveform
    begins: str  # initial state of the compensator in words; empty without a compensator
    reference_min: float  # lowest reference, in the waveform's unit
    reference_max: float
    command_unit: str
    command_min: float
    command_max: float
    slew_per_s: float  # fastest change of the command
    lowest_at_s: float  # time of the lowest command, from the start of the conditioning
    highest_at_s: float
    fastest_at_s: float
    voltage_v: float | None  # largest voltage of the amplifier; None without its limit
    voltage_at_s: float
    heat: RunHeat  # effect on the heat of the coil, whatever the heat before
    begins_rms_a: float | None  # running rms after the last run; None without a thermal budget
    heating_rms_a: float | None  # highest running rms of the coil current; None without a budget
    budget_used_s: float | None  # time at which the thermal budget is exceeded, if it is
    recording_mb: float  # approximate size of the recording
    highest_rate_hz: float
    rate_note: str  # reason for the highest rate; may be empty
    first_command: float  # of the waveform
    line: LinearBypass | None  # replacement of a bypassed inverse; None if there is none

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields for the user as plain values."""
        mapping = asdict(self)
        del mapping["heat"], mapping["first_command"], mapping["line"]  # intermediate results
        return mapping


def forecast_of(
    rig: RunRig,
    model: HysteresisModel | None,
    reference: Reference,
    begun: CompensatorStart,
    conditioned: F64,
    heat_a2: float = 0.0,
    input_um: Callable[[int, int], F64] | None = None,
    recording_mb: float = 0.0,
) -> Forecast:
    """Compute all commands of a run: ``conditioned``, float64[m], then those of the waveform.

    ``heat_a2`` is the coil's heat before, in A^2. ``input_um`` returns a different input from a
    start to a stop, and is called in order.

    Raises:
        ModelError: The model has no inverse.
    """
    info, rate_hz, safe = rig.info, rig.exchange.rate_hz, rig.command.safe
    compensator = Compensator(model, rate_hz)
    if begun.state is not None:
        compensator.restore(begun.state)
    heat_a2 = max(heat_a2, safe**2)
    command, ends = CommandFigures(rig, safe, heat_a2), LineEnds()
    if conditioned.size:
        command.add(conditioned)
    values = reference.values
    simulate_commands(
        compensator,
        input_um or (lambda start, stop: begun.input_um[start:stop]),
        lambda start, stop: values[start:stop],
        values.size,
        command,
        ends,
        reference.repeats,
    )
    low, high = reference.span
    heat = command.heat
    lowest_at_s, highest_at_s, fastest_at_s, voltage_at_s = command.places_s
    return Forecast(
        samples=values.size,
        duration_s=values.size / rate_hz,
        before_s=conditioned.size / rate_hz,
        begins=begun.begins,
        reference_min=low,
        reference_max=high,
        command_unit=info.command_unit,
        command_min=command.low,
        command_max=command.high,
        slew_per_s=command.slew_per_s,
        lowest_at_s=lowest_at_s,
        highest_at_s=highest_at_s,
        fastest_at_s=fastest_at_s,
        voltage_v=None if rig.amplifier is None else command.voltage_v,
        voltage_at_s=voltage_at_s,
        heat=heat.effect,
        begins_rms_a=None if heat.rms_a is None else math.sqrt(heat_a2),
        heating_rms_a=heat.rms_a,
        budget_used_s=heat.used_s,
        recording_mb=recording_mb,
        highest_rate_hz=info.max_rate_hz,
        rate_note=info.rate_note,
        first_command=ends.first,
        line=None if model is None else ends.line(),
    )


def simulate_commands(
    compensator: Compensator,
    input_um: Callable[[int, int], F64],
    reference: Callable[[int, int], F64],
    size: int,
    figures: "CommandFigures",
    ends: "LineEnds",
    repeats: tuple[RepeatedPart, ...],
) -> None:
    """Simulate the commands of a run, without the repeats of cycles that agree.

    ``input_um`` and ``reference`` return their samples from a start to a stop, and are called in
    order. ``repeats`` are the periodic parts of the reference in order.
    """
    at = 0

    def advance(stop: int, cycle: F64 | None = None) -> None:
        """Simulate up to a sample; fill ``cycle`` (float64[n]) with the commands."""
        nonlocal at
        begins = at
        while at < stop:
            start, at = at, min(at + CHUNK, stop)
            command = np.empty(at - start)
            compensator.process(input_um(start, at), command)
            figures.add(command)
            ends.add(reference(start, at), command)
            if cycle is not None:
                cycle[start - begins : at - begins] = command

    for repeat in repeats:
        advance(repeat.start)
        # The input runs ahead of the reference, so its periodic part ends earlier.
        stop = repeat.stop - compensator.preview
        cycle = whole_cycle(repeat.period, stop - repeat.start)
        before, now = np.full((2, cycle), math.nan)
        while cycle and stop - at >= 3 * cycle:
            before_a2 = figures.heat.heat_a2
            advance(at + cycle, now)
            times = (stop - at) // cycle - 1
            with np.errstate(over="ignore", invalid="ignore"):  # NaN never agrees
                same = bool(np.abs(now - before).max() * times <= _SAME * np.ptp(now))
            if same:
                figures.skip(before_a2, cycle, times)
                at += times * cycle
                break
            before, now = now, before
    advance(size)


def whole_cycle(period: float, samples: int) -> int:
    """Return the shortest whole cycle, at most a quarter of the samples; 0 if there is none."""
    for periods in range(1, _MOST_PERIODS + 1):
        length = periods * period
        if length > LONG or 4 * length > samples:
            return 0
        if abs(length - round(length)) * (samples / length) <= _WHOLE:
            times = max(1, math.ceil(_LEAST_CYCLE / length))
            cycle = times * round(length)
            return cycle if 4 * cycle <= samples else 0
    return 0


class CommandFigures:
    """Range, slew, voltage and heat of consecutive commands.

    Attributes:
        last: Command before the next ones.
        voltage_v: Largest magnitude of the amplifier's voltage; 0 without its limit.
    """

    def __init__(self, rig: RunRig, last: float, heat_a2: float) -> None:
        self.last = last
        self.low = self.high = last
        self._rate_hz = rig.exchange.rate_hz
        self.heat = CoilHeat(rig.interlocks, self._rate_hz, heat_a2)
        self._step = 0.0
        self._samples = 0
        self._amplifier = rig.amplifier
        self._current = last
        self._lag = np.full(2, last)  # memory of the current loop
        self.voltage_v = 0.0
        self._places = [0, 0, 0, 0]  # samples of lowest, highest, fastest command, largest voltage

    def add(self, command: F64) -> None:
        """Add the next commands: float64[n], n > 0."""
        with np.errstate(over="ignore", invalid="ignore"):  # such commands are rejected later
            steps = np.abs(np.diff(command, prepend=self.last))
            voltages = self._voltages(command)
        found = command.argmin(), command.argmax(), steps.argmax(), voltages.argmax()
        places = [int(place) for place in found]
        before = self.low, self.high, self._step, self.voltage_v
        self.low = float(np.minimum(self.low, command[places[0]]))  # keeps a NaN, unlike min()
        self.high = float(np.maximum(self.high, command[places[1]]))
        self._step = float(np.maximum(self._step, steps[places[2]]))
        self.voltage_v = float(np.maximum(self.voltage_v, voltages[places[3]]))
        for i, now in enumerate((self.low, self.high, self._step, self.voltage_v)):
            if now != before[i]:
                self._places[i] = self._samples + places[i]
        self.last = float(command[-1])
        self.heat.add(command)
        self._samples += command.size

    def _voltages(self, command: F64) -> F64:
        """Return the magnitude of the amplifier's voltage after each command; 0 without a limit."""
        amplifier, current = self._amplifier, command
        if amplifier is None:
            return np.zeros(command.size)
        if amplifier.bandwidth_hz is not None:
            current = np.empty(command.size)
            periods = 2.0 * math.pi * amplifier.bandwidth_hz / self._rate_hz
            lag_block(command, periods, 0.0, self._lag, current)
        currents = np.append(self._current, current)
        self._current = float(current[-1])
        return np.abs(amplifier.voltage_v(currents, 1.0 / self._rate_hz))

    def skip(self, heat_a2: float, samples: int, times: int) -> None:
        """Add the last ``samples`` ``times`` more times; the heat before them was ``heat_a2``."""
        self.heat.repeat(heat_a2, samples, times)
        self._samples += samples * times

    @property
    def places_s(self) -> tuple[float, float, float, float]:
        """Times of the lowest, highest and fastest command and of the largest voltage, in s."""
        low, high, fast, voltage = (place / self._rate_hz for place in self._places)
        return low, high, fast, voltage

    @property
    def slew_per_s(self) -> float:
        """Fastest change."""
        return self._step * self._rate_hz


class LineEnds:
    """Collects the ends of the line that replaces the inverse while it is bypassed.

    The line has the stroke of the compensator but no hysteresis: it leads from the lowest to the
    highest command over the waveform, so the difference between the two is the inverse's effect.
    """

    def __init__(self) -> None:
        self.first = math.nan
        """The first command."""
        self._low, self._high = (math.inf, math.nan), (-math.inf, math.nan)
        self._lowest, self._highest = math.inf, -math.inf

    def add(self, reference: F64, command: F64) -> None:
        """Add the next samples: float64[n] each, n > 0."""
        self.first = float(command[0]) if math.isnan(self.first) else self.first
        low, high = int(reference.argmin()), int(reference.argmax())
        self._low = min(self._low, (float(reference[low]), float(command[low])))
        self._high = max(self._high, (float(reference[high]), float(command[high])))
        self._lowest = float(np.minimum(self._lowest, command.min()))
        self._highest = float(np.maximum(self._highest, command.max()))

    def line(self) -> LinearBypass | None:
        """Return the line; None if the reference is constant or a command is not finite."""
        (low_um, at_low), (high_um, at_high) = self._low, self._high
        rise = self._highest - self._lowest
        if not (high_um > low_um and math.isfinite(rise)):
            return None
        # On one wing of a butterfly the displacement rises when the command falls.
        slope = math.copysign(rise, at_high - at_low) / (high_um - low_um)
        middle_um = 0.5 * (low_um + high_um)
        return LinearBypass(slope, 0.5 * (self._lowest + self._highest) - slope * middle_um)
