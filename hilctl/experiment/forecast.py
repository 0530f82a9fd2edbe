"""What a run will do, worked out by the same compensator that will run."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.base.types import F64
from hilctl.experiment.coil_heat import CoilHeat, RunHeat
from hilctl.experiment.command_simulation import CommandSimulation
from hilctl.experiment.file import Experiment
from hilctl.experiment.initial_state import CompensatorStart
from hilctl.experiment.linear_bypass import LineEnds
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.compensator import Compensator
from hilctl.loop.tuning import LinearBypass
from hilctl.waveforms.build import Reference

_BYTES_A_SAMPLE = 45.0
_BYTES_OF_INPUT = 8.0


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run will do.

    Attributes:
        samples: Samples of the waveform.
        duration_s: Its length.
        before_s: Time of the conditioning before it.
        begins: Where the compensator begins, in words; empty without one.
        reference_min: Lowest reference, in the waveform's unit.
        reference_max: Highest reference.
        command_unit: ``A`` or ``V``.
        command_min: Lowest command.
        command_max: Highest command.
        slew_per_s: Fastest change of the command.
        heat: What it does to the heat of the coil, whatever that is before.
        begins_rms_a: Running rms of the coil current that it begins with, by what the last run of
            the device left; None where there is no budget.
        heating_rms_a: Highest running rms of the coil current, as the thermal budget has it; None
            where there is no budget.
        budget_used_s: Time after which the thermal budget is overdrawn; None where it is kept.
        recording_mb: About how large the recording will be.
        highest_rate_hz: Highest sample rate that the device can keep.
        rate_note: Why that is so; empty where there is no more to say.
        line: What can take the inverse's place; None where nothing can.
    """

    samples: int
    duration_s: float
    before_s: float
    begins: str
    reference_min: float
    reference_max: float
    command_unit: str
    command_min: float
    command_max: float
    slew_per_s: float
    heat: RunHeat
    begins_rms_a: float | None
    heating_rms_a: float | None
    budget_used_s: float | None
    recording_mb: float
    highest_rate_hz: float
    rate_note: str
    line: LinearBypass | None

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        mapping = asdict(self)
        del mapping["heat"]  # a part of a campaign's sums, of no meaning by itself
        del mapping["line"]  # of no meaning before somebody asks for it
        return mapping


def forecast_of(
    loaded: LoadedExperiment,
    reference: Reference,
    begun: CompensatorStart,
    conditioned: F64,
    heat_a2: float = 0.0,
    input_um: Callable[[int, int], F64] | None = None,
) -> Forecast:
    """Run the compensator on its input, and note what comes of it.

    Args:
        loaded: The experiment.
        reference: Every sample of its waveform.
        begun: The compensator's input, and its memory at the start.
        conditioned: float64[m], commands that come before the waveform's.
        heat_a2: Running mean square of the coil current before all of them, in A^2.
        input_um: Gives another input from a start to a stop, one part after the other.

    Raises:
        ModelError: The model has no inverse.
    """
    config = loaded.config
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    if begun.state is not None:
        compensator.restore(begun.state)
    heat_a2 = max(heat_a2, config.safe.value**2)
    figures = _RunFigures(config, heat_a2)
    if conditioned.size:
        figures.add_before(conditioned)
    values = reference.values
    run = CommandSimulation(
        compensator,
        input_um or (lambda start, stop: begun.input_um[start:stop]),
        lambda start, stop: values[start:stop],
        values.size,
        figures,
    )
    run.go_through(reference.repeats)
    byte_count = _BYTES_A_SAMPLE + (0.0 if begun.input_um is values else _BYTES_OF_INPUT)
    low, high = reference.span
    command, heat = figures.command, figures.command.heat
    return Forecast(
        samples=values.size,
        duration_s=values.size / config.sample_rate_hz,
        before_s=conditioned.size / config.sample_rate_hz,
        begins=begun.begins,
        reference_min=low,
        reference_max=high,
        command_unit=loaded.device.info.command_unit,
        command_min=command.low,
        command_max=command.high,
        slew_per_s=command.slew_per_s,
        heat=figures.heat,
        begins_rms_a=None if heat.rms_a is None else math.sqrt(heat_a2),
        heating_rms_a=heat.rms_a,
        budget_used_s=heat.used_s,
        recording_mb=(values.size + conditioned.size) * byte_count / 1e6,
        highest_rate_hz=loaded.device.info.max_rate_hz,
        rate_note=loaded.device.info.rate_note,
        line=None if loaded.model is None else figures.ends.line(),
    )


class _RunFigures:
    """What is gathered from the commands of a whole run; see :class:`whole_run.Figures`."""

    def __init__(self, config: Experiment, heat_a2: float) -> None:
        self.command = CommandFigures(config, config.safe.value, heat_a2)
        self.heat = RunHeat()
        self.ends = LineEnds()
        self._limits, self._rate_hz = config.limits, config.sample_rate_hz
        self._marked = 0.0, 0.0

    def add_before(self, command: F64) -> None:
        """Take commands that come before the waveform: float64[n], n > 0."""
        self.command.add(command)
        self.heat = self.heat.then(command, self._limits, self._rate_hz)

    def add(self, reference: F64, command: F64) -> None:
        """Take the next ones: float64[n] each, n > 0."""
        self.add_before(command)
        self.ends.add(reference, command)

    def mark(self) -> None:
        """Note that a cycle begins."""
        self._marked = self.command.heat.heat_a2, self.heat.alone_a2

    def pass_over(self, samples: int, times: int) -> None:
        """Take the cycle since the mark, of so many samples, that many times more."""
        before_a2, alone_a2 = self._marked
        self.command.heat.pass_over(before_a2, samples, times)
        self.heat = self.heat.pass_over(alone_a2, samples, times, self._limits, self._rate_hz)


class CommandFigures:
    """What limits are held against, gathered from commands that follow one another.

    Args:
        config: The experiment.
        last: Command before the first of them.
        heat_a2: Running mean square of the coil current before them, in A^2.

    Attributes:
        low: Lowest command.
        high: Highest command.
        last: Command before the next ones.
        heat: The thermal budget.
    """

    def __init__(self, config: Experiment, last: float, heat_a2: float) -> None:
        self.last = last
        self.low = self.high = last
        self.heat = CoilHeat(config.limits, config.sample_rate_hz, heat_a2)
        self._rate_hz = config.sample_rate_hz
        self._step = 0.0

    def add(self, command: F64) -> None:
        """Go on with the next commands: float64[n], n > 0."""
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
            steps = np.abs(np.diff(command, prepend=self.last))
        self.low = float(np.minimum(self.low, command.min()))  # keeps a NaN, where min() would not
        self.high = float(np.maximum(self.high, command.max()))
        self._step = float(np.maximum(self._step, steps.max()))
        self.last = float(command[-1])
        self.heat.add(command)

    @property
    def slew_per_s(self) -> float:
        """Fastest change."""
        return self._step * self._rate_hz
