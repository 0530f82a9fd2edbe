"""A change of gain, offset or inverse, worked out from where the run stands before it is made.

The rest of a run may be hours long, and who asks for a change waits. So commands are worked out by
the compensator that runs, from the present sample and its memory on, through the ramp of the change
and for as long as there is time:

- What repeats is passed over once two cycles after each other came out the same: the memory is
  then that of the cycle, and the ones that follow are like it.
- Where the time is up, the places of the rest are tried where the input is highest, lowest and
  fastest, as gain and offset move no such place.

What was worked out is said in the answer, and the limiter is the last word in any case.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import ConfigError
from hilctl.base.segments import Segment
from hilctl.base.values import Values, in_memory
from hilctl.experiment.check import Checked, command_problems, reference_problems
from hilctl.experiment.forecast import CommandFigures, Forecast
from hilctl.loop.compensator import Compensator
from hilctl.loop.host import Tuning
from hilctl.loop.tuning import Factors, Tuner, tune

_CHUNK = 4096
_PEAK_BLOCK = 65536
_FAR = 4_000_000
_MOST_PERIODS = 32
_SAME = 1e-3
"""Two cycles are the same where they differ by less than this part of their span."""
_WINDOW = 1024
"""Samples that are worked out on either side of one place."""


@dataclass(frozen=True, slots=True)
class RunPosition:
    """Where a run stands.

    Attributes:
        sample: Next sample.
        state: float64[state_size], the compensator's memory before it; None at its start.
        tuner: Gain and offset there, and the change under way; not moved here.
        heat_a2: Highest running mean square of the coil current that it can have come to, in A^2.
    """

    sample: int
    state: F64 | None
    tuner: Tuner
    heat_a2: float


@dataclass(frozen=True, slots=True)
class TunedForecast:
    """What a run would do with another gain, offset and share of the inverse, within its limits.

    Attributes:
        tuning: The change.
        checked_s: Time of the run, from where it stands, of which every command is known.
        to_the_end: Whether that is all of it; else the rest was tried where it goes furthest.
        heat_a2: Highest running mean square of the coil current, in A^2.
    """

    tuning: Tuning
    checked_s: float
    to_the_end: bool
    heat_a2: float


class InputPeaks:
    """Where the compensator's input is highest, lowest and fastest, from any sample on.

    Where it does not fit in memory, over the next samples alone.

    Args:
        input_um: float64[n].
    """

    def __init__(self, input_um: Values) -> None:
        self._input_um = input_um
        self._places = self._values = np.empty((0, 3))
        self._begins = 0
        if in_memory(input_um):
            self._look_from(0)

    def after(self, sample: int) -> list[int]:
        """Return the three places at or after ``sample``, to within a block of samples."""
        if not in_memory(self._input_um):
            self._look_from(sample)
        first = min((sample - self._begins) // _PEAK_BLOCK, len(self._places) - 1)
        chosen = self._values[first:].argmax(axis=0)
        return [max(sample, int(place)) for place in self._places[first:][chosen, range(3)]]

    def _look_from(self, sample: int) -> None:
        values = self._input_um
        self._begins = sample
        stop = values.size if in_memory(values) else min(sample + _FAR, values.size)
        starts = range(sample, stop, _PEAK_BLOCK)
        found = [_peaks(values[start : start + _PEAK_BLOCK + 1]) for start in starts]
        self._places = np.array([places for places, _ in found]) + np.array(starts)[:, None]
        self._values = np.array([heights for _, heights in found])


def _peaks(values: F64) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
    """Return where values are highest, lowest and fastest, and how high, deep and fast."""
    steps = np.abs(np.diff(values, append=values[-1]))
    places = int(values.argmax()), int(values.argmin()), int(steps.argmax())
    high, low, fast = places
    return places, (float(values[high]), -float(values[low]), float(steps[fast]))


def tuned_forecast(
    checked: Checked,
    peaks: InputPeaks,
    position: RunPosition,
    tuning: Tuning,
    in_time: Callable[[], bool],
) -> TunedForecast:
    """Work out what a running reference would do with another gain, offset or inverse.

    Args:
        checked: The experiment that runs.
        peaks: Of its compensator's input.
        position: Where it stands.
        tuning: The change; it begins at a block's first sample.
        in_time: Whether there is time left.

    Raises:
        ConfigError: It would leave model or limits; the error says by how much.
    """
    walk = _Walk(checked, position, tuning)
    to_the_end = _follow(walk, in_time)
    known = walk.sample
    if not to_the_end:
        ends = [tuning.begins_at, tuning.begins_at + tuning.samples]
        walk.try_around([*ends, *peaks.after(known)])
    problems = command_problems(checked.loaded, walk.forecast())
    # What the run had before the change has been approved: the new gain and offset alone count.
    ends_um = [end * tuning.gain + tuning.offset for end in _span_after(checked, position.sample)]
    low, high = sorted(ends_um)
    problems += reference_problems(checked.loaded, checked.reference.unit, low, high)
    if problems:
        raise ConfigError(problems)
    seconds = (known - position.sample) / checked.loaded.config.sample_rate_hz
    return TunedForecast(tuning, seconds, to_the_end, walk.figures.heat.highest_a2)


def _span_after(checked: Checked, sample: int) -> tuple[float, float]:
    """Return lowest and highest reference after a sample; of all, where that fits no memory."""
    reference = checked.reference
    if not in_memory(reference.values):
        return reference.span
    values = reference.values[sample:]
    return float(values.min()), float(values.max())


def _follow(walk: "_Walk", in_time: Callable[[], bool]) -> bool:
    """Work out all there is; return False where the time was up before the end."""
    if not walk.on_to(walk.settled, in_time):
        return False
    for segment in walk.reference.segments:
        if segment.stop <= walk.sample:
            continue
        periods = _whole_periods(segment.period)
        if periods and not _pass_over_cycles(walk, segment, periods, in_time):
            return False
        if not walk.on_to(segment.stop, in_time):
            return False
    return True


def _whole_periods(period: float) -> int:
    """Return how many periods come nearest to whole samples; 0 where nothing repeats."""
    if period <= 0.0:
        return 0
    return min(range(1, _MOST_PERIODS + 1), key=lambda n: (round(_off(n * period), 6), n))


def _off(samples: float) -> float:
    return abs(samples - round(samples))


def _pass_over_cycles(
    walk: "_Walk", segment: Segment, periods: int, in_time: Callable[[], bool]
) -> bool:
    """Go on until the steady part repeats, and to its last cycles; False where time was up."""
    length = periods * segment.period
    cycle = round(length)
    before: F64 | None = None
    if not walk.on_to(segment.steady_start, in_time):
        return False
    while walk.sample + 2 * cycle <= segment.steady_stop:
        commands: list[F64] = []
        if not walk.on_to(walk.sample + cycle, in_time, commands.append):
            return False
        now = np.concatenate(commands)
        if before is not None and np.abs(now - before).max() <= _SAME * np.ptp(now):
            # One more to come back into step, and one that is judged, as it ends what repeats.
            times = int((segment.steady_stop - walk.sample) / length) - 2
            if times > 0:
                walk.repeat(now, times, round(times * length))
            return True
        before = now
    return True


class _Walk:
    """Goes through the rest of a run, as its loop would."""

    def __init__(self, checked: Checked, position: RunPosition, tuning: Tuning) -> None:
        loaded, self.reference = checked.loaded, checked.reference
        self.sample = position.sample
        self.settled = tuning.begins_at + tuning.samples
        self._checked, self._tuning = checked, tuning
        self._input_um = checked.begun.input_um
        self._compensator = Compensator(loaded.model, loaded.config.sample_rate_hz)
        state = checked.begun.state if position.state is None else position.state
        if state is not None:
            self._compensator.restore(state)
        self._tuner = copy(position.tuner)
        # From nowhere: the first command makes no step.
        self.figures = CommandFigures(loaded.config, None, position.heat_a2)

    def on_to(
        self, stop: int, in_time: Callable[[], bool], take: Callable[[F64], None] | None = None
    ) -> bool:
        """Work out the commands up to ``stop``; return False where the time was up before."""
        stop = min(stop, self._input_um.size)
        while self.sample < stop:
            if not in_time():
                return False
            commands = self._commands(min(stop, self.sample + _CHUNK))
            self.figures.add(commands)
            if take is not None:
                take(commands)
        return True

    def repeat(self, cycle: F64, times: int, samples: int) -> None:
        """Pass over cycles that are like ``cycle`` (float64[n]); they take ``samples`` in all."""
        self.figures.heat.repeat(cycle, times)
        self._jump(self.sample + samples)
        # Where no whole number of samples is a cycle, this is not quite where a cycle begins: what
        # comes of that half a sample is not held against the change.
        self._unjudged(cycle.size)

    def try_around(self, places: Sequence[int]) -> None:
        """Work out what surrounds some samples, each from the memory as it is now."""
        begins, state, tuner = self.sample, self._compensator.state(), copy(self._tuner)
        for place in places:
            self.sample, self._tuner = begins, copy(tuner)
            self._compensator.restore(state)
            if (start := place - 3 * _WINDOW) > begins:
                self._jump(start)
                # The jump is not the run's: it must have died out before anything is judged.
                self._unjudged(2 * _WINDOW)
            else:
                self.figures.last = None
            self.on_to(max(begins, place) + _WINDOW, lambda: True)
        self.figures.heat.expect(self._later_heat_a2())

    def forecast(self) -> Forecast:
        """Return what the run as it was checked would do, with the figures found here."""
        figures = self.figures
        return replace(
            self._checked.forecast,
            command_min=figures.low,
            command_max=figures.high,
            slew_per_s=figures.slew_per_s,
            heating_rms_a=figures.heat.rms_a,
            budget_used_s=figures.heat.used_s,
        )

    def _later_heat_a2(self) -> float:
        """Return the heat of the run as it was checked, as much more as the commands are larger."""
        before, now = self._checked.forecast, self.figures
        largest = max(abs(now.low), abs(now.high))
        largest_before = max(abs(before.command_min), abs(before.command_max))
        heat = before.heating_rms_a or 0.0
        part = heat / largest_before if largest_before else 1.0
        return (part * largest) ** 2

    def _unjudged(self, samples: int) -> None:
        stop = min(self.sample + samples, self._input_um.size)
        while self.sample < stop:
            self.figures.last = float(self._commands(min(stop, self.sample + _CHUNK))[-1])

    def _jump(self, sample: int) -> None:
        begins_at = self._tuning.begins_at
        if self.sample <= begins_at < sample:
            self._tuner.pass_over(begins_at - self.sample)
            self._tuner.move(self._tuning)
            self.sample = begins_at
        self._tuner.pass_over(sample - self.sample)
        self.sample = sample

    def _commands(self, stop: int) -> F64:
        """Work out commands up to ``stop``, or up to where the change begins."""
        begins_at = self._tuning.begins_at
        if self.sample == begins_at:
            self._tuner.move(self._tuning)
        elif self.sample < begins_at:
            stop = min(stop, begins_at)
        values = self._input_um[self.sample : stop]
        factors = self._tuner.advance(values.size)
        commands = np.empty(values.size)
        if factors is None:
            self._compensator.process(values, commands)
        else:
            with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
                self._tuned(factors, values, commands)
        self.sample = stop
        return commands

    def _tuned(self, factors: Factors, values: F64, commands: F64) -> None:
        """Fill commands from the input (float64[n] each) of the samples that come now."""
        reference, input_um = np.empty_like(values), np.empty_like(values)
        tune(factors, values, input_um)
        self._compensator.process(input_um, commands)
        here = slice(self.sample, self.sample + values.size)
        tune(factors, self.reference.values[here], reference)
        self._tuner.fade(factors, reference, commands, np.zeros(values.size, dtype=np.uint32))
